"""What an executor is asked to run, and what it hears of it."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any

from roel_service.errors import RoelError
from roel_service.progress import Progress

GIB = 2**30


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What one attempt may use.

    Attributes:
        memory_bytes: resident memory, without files that are only mapped.
        time_s: wall clock.
    """

    memory_bytes: int = 2 * GIB
    time_s: float = 3600.0


@dataclass(frozen=True, kw_only=True)
class TaskSpec:
    """Work for an executor.

    Attributes:
        entrypoint: `module:function`, imported where it runs alone; it is called with the
            parameters and a `Tell`. Or `module:Class`, of which one object for each child is called.
        parameters: anything that can be pickled; inputs are named by files that never change.
    """

    entrypoint: str
    parameters: Any
    limits: Limits = Limits()


@dataclass(frozen=True, kw_only=True)
class Partial:
    """A result that can be used before the last one."""

    result: Any


@dataclass(frozen=True)
class Ready:
    """A child waits for its first task."""


@dataclass(frozen=True, kw_only=True)
class Usage:
    """What an attempt has used so far."""

    cpu_s: float
    peak_rss_mib: float


@dataclass(frozen=True, kw_only=True)
class Done:
    """The last message of work that succeeded."""

    result: Any


@dataclass(frozen=True, kw_only=True)
class Failed:
    """The last message of work with a bug.

    Attributes:
        fingerprint: equal for equal failures: kind and place, not the text.
        traceback: for the log.
    """

    fingerprint: str
    traceback: str


# What work says while it runs; called often and cheaply.
Tell = Callable[[Progress | Partial], None]

# Told while work runs, then one of the others ends it.
News = Progress | Partial | Usage
Message = News | Done | Failed | RoelError

OnNews = Callable[[News], Awaitable[None]]
