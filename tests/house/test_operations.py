"""The marked blocks of docs/operations.md are run, in their order and in one folder."""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
MARK = "<!-- executed by tests/house/test_operations.py -->"


def script() -> str:
    """All marked blocks as one, on ports that are free."""
    pattern = re.compile(re.escape(MARK) + r"\n```(console|python)\n(.*?)```", re.DOTALL)
    blocks = pattern.findall((ROOT / "docs" / "operations.md").read_text())
    commands = "\n".join(shell(language, text) for language, text in blocks)
    for port in ("50051", "9464"):
        commands = commands.replace(port, str(free_port()))
    return commands


def shell(language: str, text: str) -> str:
    """A block as the shell takes it."""
    if language == "python":
        return f"python - <<'END'\n{text}END"
    return "\n".join(line.removeprefix("$ ") for line in text.splitlines())


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def test_marked_commands_run(tmp_path: Path) -> None:
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    # Whatever fails, the server in the background ends.
    text = "set -euo pipefail\ntrap 'kill $(jobs -p) 2>/dev/null || true' EXIT\n" + script()
    done = subprocess.run(
        ["bash", "-c", text],
        cwd=tmp_path,
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr + (tmp_path / "server.log").read_text()
    assert "roel_rpc_handled_total" in done.stdout
    assert "robot-1 /roel_service.v1.MapService/CreateMap projects/default OK" in done.stdout
    assert (tmp_path / "robot-1.token").read_text().startswith("roel_")
