"""`roel map import` and what `roel map export` made."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from roel_client.local.maps import read_map_file
from tests.register.rooms import room_map

ROEL = Path(sys.executable).with_name("roel")


def roel(folder, *arguments):
    command = [ROEL, "map", *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def drawing(tmp_path_factory):
    """Lines of a room as a program for drawing writes them, one of them without length."""
    path = tmp_path_factory.mktemp("drawing") / "room.obj"
    rows = [*room_map().segments, np.ones((2, 3))]
    path.write_text(
        "".join(
            f"v {a[0]} {a[1]} {a[2]}\nv {b[0]} {b[1]} {b[2]}\nl -2 -1\n" for a, b in np.array(rows)
        )
    )
    return path


def test_a_drawing_becomes_a_map(drawing):
    done = roel(drawing.parent, "import", drawing.name, "--out", "room.rlm")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == "room.rlm: 60 lines from obj, 1 without length left out\n"
    segments = read_map_file(str(drawing.parent / "room.rlm")).line_map.segments
    # Which end comes first, and which line, is not kept.
    ends, expected = (np.sort(s.reshape(-1, 3), axis=0) for s in (segments, room_map().segments))
    np.testing.assert_allclose(ends, expected, atol=5e-4)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"what is this", "expected a map file, or lines as one of npz, json, csv, obj"),
        (b"[]", "expected lines in the format json, found no segments"),
        (b"v 0 0 0\n", "expected lines, found none"),
    ],
)
def test_other_files_are_refused_and_nothing_is_written(tmp_path, content, told):
    (tmp_path / "lines").write_bytes(content)
    done = roel(tmp_path, "import", "lines", "--out", "room.rlm")
    assert done.returncode == 2
    assert told in done.stderr
    assert done.stderr.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["lines"]
