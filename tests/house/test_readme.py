"""The README's marked blocks are run, in their order and in one folder, as a reader would."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
MARK = "<!-- executed by tests/house/test_readme.py -->"


def executed_blocks() -> list[tuple[str, str]]:
    """(language, text) of every marked block."""
    pattern = re.escape(MARK) + r"\n```(\w+)\n(.*?)```"
    return re.findall(pattern, (ROOT / "README.md").read_text(), re.DOTALL)


def commands(language: str, text: str) -> list[list[str]]:
    if language == "python":
        return [[sys.executable, "-c", text]]
    prompts = [line for line in text.splitlines() if line.startswith("$ ")]
    return [shlex.split(line.removeprefix("$ ")) for line in prompts]


def test_marked_commands_run(tmp_path: Path) -> None:
    blocks = executed_blocks()
    assert [language for language, _ in blocks] == ["console", "python"]
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    for language, text in blocks:
        for command in commands(language, text):
            done = subprocess.run(
                command,
                cwd=tmp_path,
                env={**os.environ, "PATH": path},
                capture_output=True,
                text=True,
                check=False,
            )
            assert done.returncode == 0, f"{command}\n{done.stderr}"
    assert (tmp_path / "room.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "room.ply").read_bytes().startswith(b"ply")
