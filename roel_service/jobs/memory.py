"""Memory of processes, as Linux tells it; elsewhere nothing is known, and nothing is limited."""

from __future__ import annotations

import contextlib
import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

# Writable address space per byte of the resident limit: libraries reserve more than they touch
# (a build of room size: 434 MiB reserved, 225 MiB touched).
RESERVED_SHARE = 2

# To the kernel a child is the first to go when memory runs out, long before the server.
CHILD_OOM_SCORE = "800"


def resident_bytes(pid: int) -> int:
    """Memory that a process has touched and shares with no file; 0 if it cannot be known."""
    try:
        _, resident, shared, *_ = Path(f"/proc/{pid}/statm").read_text().split()
    except (OSError, ValueError):
        return 0
    return (int(resident) - int(shared)) * os.sysconf("SC_PAGE_SIZE")


def cpu_s(pid: int) -> float:
    """Processor time of a process so far; 0 if it cannot be known."""
    try:
        # The name of the program, in parentheses, may hold blanks.
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def kernel_kill_count() -> int:
    """How often the kernel has ended a process of this machine because memory ran out."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/vmstat").read_text().splitlines():
            if line.startswith("oom_kill "):
                return int(line.split()[1])
    return 0


def volunteer() -> None:
    """Let the kernel choose this process when memory runs out."""
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(CHILD_OOM_SCORE)


@contextmanager
def reserving_at_most(limit_bytes: int) -> Iterator[None]:
    """Make allocations far beyond a resident limit fail at once, as `MemoryError`."""
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    wanted = RESERVED_SHARE * limit_bytes
    allowed = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
    resource.setrlimit(resource.RLIMIT_DATA, (allowed, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))
