"""The server that is killed, and its children."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import IO

from roel_service.failpoints import MET, VARIABLE


class Victim:
    """A server process on a data folder.

    Args:
        folder: the data folder.
        port: 0 takes a free one.
        log: a file, for what it and its children write to stderr.
        failpoint: as `ROEL_FAILPOINT`; its children have it too.
    """

    def __init__(self, folder: Path, port: int, log: IO[bytes], failpoint: str = "") -> None:
        self._log = Path(log.name)
        self._began_bytes = self._log.stat().st_size
        environment = {**os.environ, VARIABLE: failpoint}
        command = [sys.executable, "-m", "roel_crash.serve", str(folder), str(port)]
        self._process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=log, env=environment
        )
        assert self._process.stdout is not None
        # Nothing if a failpoint was met before the server was ready.
        line = self._process.stdout.readline().strip()
        self.port = int(line) if line else port

    def kill(self) -> None:
        """SIGKILL; its children end by themselves."""
        self._process.kill()

    def is_dead_within(self, seconds: float) -> bool:
        """Whether it has died, waiting for that."""
        try:
            self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            return False
        self._close()
        return True

    def has_met(self, failpoint: str) -> bool:
        """Whether it or one of its children died at a failpoint."""
        with self._log.open("rb") as file:
            file.seek(self._began_bytes)
            return f"{MET} {failpoint}\n".encode() in file.read()

    def stop(self) -> int:
        """Drain it; the exit code."""
        self._process.terminate()
        code = self._process.wait(60)
        self._close()
        return code

    def kill_a_child(self) -> bool:
        """SIGKILL one of its children; False if there is none."""
        for child in _children(self._process.pid):
            with contextlib.suppress(ProcessLookupError):
                os.kill(child, signal.SIGKILL)
                return True
        return False

    def _close(self) -> None:
        assert self._process.stdout is not None
        self._process.stdout.close()


def _children(pid: int) -> list[int]:
    found = []
    for status in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            text = status.read_text()
            command, parent = status.parent / "cmdline", text.rpartition(")")[2].split()[1]
            # Python starts a tracker of resources beside the children.
            if int(parent) == pid and b"spawn_main" in command.read_bytes():
                found.append(int(status.parent.name))
    return found
