"""`roel bench mapping` as a script meets it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from roel_bench import suites
from roel_bench.catalogue import WARM_UP_ROOM
from roel_client.cli.bench import SUITES

ROEL = Path(sys.executable).with_name("roel")


def bench(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    command = [ROEL, "bench", "mapping", *arguments]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)


def test_command_line_knows_every_suite() -> None:
    assert set(SUITES) == set(suites.SUITES)


def test_smoke_run_leaves_rows_table_and_pictures(tmp_path: Path, rooms: Path) -> None:
    names = ("--scenes", WARM_UP_ROOM, "--variants", "default")
    done = bench("--out", "run", "--rooms", str(rooms), *names, "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert document == json.loads((tmp_path / "run" / "mapping.json").read_text())
    assert [row["task"] for row in document["rows"]] == ["map", "map", "front_end"]
    assert (tmp_path / "run" / "mapping.md").read_text().startswith("## Maps")
    assert sorted(path.name for path in (tmp_path / "run").iterdir()) == [
        "mapping.json",
        "mapping.md",
        "pictures",
    ]


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ([], "roel bench mapping: expected --out, found none"),
        (["--out", "run", "--suite", "nope"], "--suite: expected one of quick"),
        (["--out", "run", "--scenes", "nope"], "scene: expected one of sim_SEED"),
        (["--out", "taken"], "taken: expected a folder to write to"),
    ],
)
def test_mistakes_are_told_in_one_line(tmp_path: Path, arguments: list[str], line: str) -> None:
    (tmp_path / "taken").write_text("a file")
    done = bench(*arguments, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert line in done.stderr
    assert done.stderr.count("\n") == 1
