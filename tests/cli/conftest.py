from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROEL = Path(sys.executable).with_name("roel")


@pytest.fixture
def server(tmp_path: Path) -> Iterator[str]:
    """Address of a server that runs as a process; it has to end with 0."""
    process = subprocess.Popen(
        [ROEL, "serve", "--data", "data", "--port", "0"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    try:
        yield json.loads(process.stdout.readline())["address"]
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=60) == 0
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
