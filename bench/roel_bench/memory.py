"""The largest resident memory of a stretch of work."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path

# Linux keeps a high-water mark of each process, which writing 5 here sets back.
CLEAR = Path("/proc/self/clear_refs")
STATUS = Path("/proc/self/status")


def reset_peak() -> None:
    """Forget the memory of what was done before, where the system can."""
    with suppress(OSError):
        CLEAR.write_text("5", encoding="ascii")


def peak_mib() -> float | None:
    """The largest resident memory since the last reset; None where the system does not tell."""
    try:
        match = re.search(r"^VmHWM:\s+(\d+) kB$", STATUS.read_text(encoding="ascii"), re.MULTILINE)
    except OSError:
        return None
    return int(match[1]) / 1024 if match else None
