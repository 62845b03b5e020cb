"""A server of this machine, as a process of its own."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def served(data: Path) -> Iterator[str]:
    """Address of a server on a folder; it drains at the end."""
    with served_by(data) as (address, _):
        yield address


@contextmanager
def served_by(data: Path) -> Iterator[tuple[str, int]]:
    """Address and process id of a server on a folder; it drains at the end."""
    command = [sys.executable, "-m", "roel_service.service", "--data", str(data), "--port", "0"]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    with process:
        assert process.stdout is not None
        try:
            yield json.loads(process.stdout.readline())["address"], process.pid
        finally:
            process.terminate()
            process.wait(60)
