"""Named places at which a process can be made to die, so that tests see what is left behind.

`ROEL_FAILPOINT=blob.linked:exit` ends the process there as a SIGKILL would; `...:exit@0.1` does so at
one pass in ten. Several are separated by commas. Without the variable nothing ever happens.
"""

from __future__ import annotations

import os
import random
import signal
import sys

VARIABLE = "ROEL_FAILPOINT"

# What a process that dies at one says last, to stderr, before the place.
MET = "died at failpoint"

# Every step after which something is durable that was not so before, in the words of its module.
FAILPOINTS = (
    "recording.created",
    "recording.written",
    "recording.synced",
    "recording.sealed",
    "blob.written",
    "blob.synced",
    "blob.linked",
    "upload.written",
    "upload.synced",
    "rows.written",
    "rows.committed",
    "task.leased",
    "task.previewed",
    "task.ended",
    "stage.cached",
    "sweep.deleted",
)

_ACTION = "exit"


def failpoint(name: str) -> None:
    """Die here, if the environment says so."""
    wanted = os.environ.get(VARIABLE)
    if wanted and random.random() < _probability(wanted, name):
        os.write(sys.stderr.fileno(), f"{MET} {name}\n".encode())
        os.kill(os.getpid(), signal.SIGKILL)


def _probability(wanted: str, name: str) -> float:
    for item in wanted.split(","):
        place, _, action = item.partition(":")
        kind, _, probability = action.partition("@")
        if place == name and kind == _ACTION:
            return float(probability or 1.0)
    return 0.0
