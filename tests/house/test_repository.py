from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TOOLS = Path(sys.executable).parent


def run(*command: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def tracked_files() -> list[Path]:
    listing = run("git", "ls-files", "-z")
    assert listing.returncode == 0, listing.stderr
    return [ROOT / name for name in listing.stdout.split("\0") if name]


def test_import_contracts_hold() -> None:
    done = run(TOOLS / "lint-imports", "--no-cache")
    assert done.returncode == 0, done.stdout


def test_no_tracked_file_is_over_one_megabyte(tracked_files: list[Path]) -> None:
    large = [path for path in tracked_files if path.exists() and path.stat().st_size > 1_000_000]
    assert large == []


def test_every_hook_runs_on_this_machine_alone() -> None:
    text = (ROOT / ".pre-commit-config.yaml").read_text()
    assert set(re.findall(r"repo: (\S+)", text)) == {"local"}
    assert set(re.findall(r"language: (\S+)", text)) == {"system"}


@pytest.mark.parametrize(
    "target",
    ["demo", "test", "check", "format", "proto", "docs", "baseline", "bench", "accuracy", "serve"],
)
def test_make_knows_the_target(target: str) -> None:
    assert run("make", "--dry-run", target).returncode == 0


def test_system_libraries_of_open3d_are_there_or_named() -> None:
    done = run(ROOT / ".ci" / "system_libraries")
    assert done.returncode == 0, done.stderr


def test_licence_of_the_metadata_is_the_licence_of_the_file() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["license"] == "Apache-2.0"
    assert "Apache License" in (ROOT / "LICENSE").read_text()[:200]


def test_links_of_the_readme_lead_somewhere() -> None:
    links = re.findall(r"\]\(([^)#]+)\)", (ROOT / "README.md").read_text())
    assert links
    assert [link for link in links if not (ROOT / link).exists()] == []
