"""How an algorithm tells its caller how far it is, and how the caller stops it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace


@dataclass(frozen=True, kw_only=True)
class Progress:
    """One step of one stage.

    Attributes:
        stage: name of the stage, as in the configuration and the report.
        done_count, total_count: units of work; total_count is 0 while it is unknown.
        fraction: share of the whole job that is done, 0 to 1.
        cached_count: units of work that an earlier job had done.
    """

    stage: str
    done_count: int
    total_count: int
    fraction: float
    cached_count: int = 0


# Called often and cheaply; raises `Cancelled` to stop the algorithm.
ProgressCallback = Callable[[Progress], None]


# The same within one stage: units of work done, and in total.
StepCallback = Callable[[int, int], None]


def ignore(progress: Progress) -> None:
    """Let the algorithm run; nobody is watching."""


def part_of(progress: ProgressCallback, begin: float, end: float) -> ProgressCallback:
    """For a job that is the part of another one from `begin` to `end`, shares of the whole."""

    def told(step: Progress) -> None:
        progress(replace(step, fraction=begin + (end - begin) * step.fraction))

    return told
