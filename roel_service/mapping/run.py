"""Bookkeeping of a mapping job: what was read, how long it took, what became of the tracks."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from roel_service.arrays import Array, IntArray
from roel_service.errors import EventsError, TrajectoryError
from roel_service.mapping.refine import Refined
from roel_service.progress import Progress, ProgressCallback
from roel_service.scene.events import EventSource, EventStream
from roel_service.scene.results import MAPPING_STAGES, TrackStatus
from roel_service.scene.trajectory import Trajectory

logger = logging.getLogger(__name__)

# Share of the whole job at which each stage begins; measured on rooms of both sensor sizes.
STAGE_BEGINS = {
    "detect": 0.0,
    "plane_fit": 0.0,
    "match_local": 0.75,
    "triangulate": 0.82,
    "match_global": 0.86,
    "refine": 0.96,
    "trim": 0.98,
}
# Poses that cover less than this share of the recording are those of another one.
MIN_COVERED_SHARE = 0.1


class CountedEvents:
    """Chunks of a recording, counted on their way through."""

    def __init__(self, events: EventSource, trajectory: Trajectory) -> None:
        self._events = events
        self._covered_us = trajectory.covered_us()
        self._range_us: tuple[int, int] | None = None
        self.total_count = 0
        self.covered_count = 0

    @property
    def time_range_us(self) -> tuple[int, int] | None:
        return self._events.time_range_us

    def chunks(self) -> Iterator[EventStream]:
        for chunk in self._events.chunks():
            if len(chunk):
                self._count(chunk.t_us)
                yield chunk

    def _count(self, t_us: Array) -> None:
        first_us = self._range_us[0] if self._range_us else int(t_us[0])
        self._range_us = (first_us, int(t_us[-1]))
        self.total_count += len(t_us)
        start = np.searchsorted(t_us, self._covered_us[:, 0])
        stop = np.searchsorted(t_us, self._covered_us[:, 1], side="right")
        self.covered_count += int((stop - start).sum())

    def counts(self) -> IntArray:
        """(4,) what was counted, and the first and last event; for `restore`."""
        return np.array([self.total_count, self.covered_count, *(self._range_us or (1, 0))])

    def restore(self, counts: IntArray) -> None:
        """Stand as if the events had been read."""
        self.total_count, self.covered_count, first_us, last_us = counts.tolist()
        self._range_us = (first_us, last_us) if first_us <= last_us else None

    def check_coverage(self) -> None:
        """Raise if there were no events, or if the poses belong to another time."""
        if self._range_us is None:
            raise EventsError("events", "at least one event", "none", reason="NO_EVENTS")
        first_us, last_us = self._range_us
        covered_us = np.clip(self._covered_us, first_us, last_us)
        share = float(np.diff(covered_us).sum()) / max(1, last_us - first_us)
        if first_us == last_us:
            share = float(self.covered_count > 0)
        if share < MIN_COVERED_SHARE:
            poses_us = self._covered_us[0, 0], self._covered_us[-1, 1]
            raise TrajectoryError(
                "poses",
                f"poses over at least {MIN_COVERED_SHARE:.0%} of the events,"
                f" {first_us * 1e-6:.6f} to {last_us * 1e-6:.6f} s",
                f"{share:.1%}, poses from {poses_us[0] * 1e-6:.6f} to {poses_us[1] * 1e-6:.6f} s",
                reason="POSE_COVERAGE_INSUFFICIENT",
            )
        left_out = self.total_count - self.covered_count
        if left_out:
            logger.warning(
                "%.1f %% of the events have no pose and are left out",
                100.0 * left_out / self.total_count,
            )


@dataclass
class MappingRun:
    """The running job: time of each stage, statuses, and what the caller is told."""

    progress: ProgressCallback
    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(MAPPING_STAGES, 0.0))
    statuses: Counter[TrackStatus] = field(default_factory=Counter)
    _stage: str = "detect"
    _fraction: float = 0.0

    def skip(self, name: str, count: int) -> None:
        """Tell the caller that a stage's results are known already: so many units of work."""
        self._stage = name
        self.step(count, count, cached_count=count)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a stage and tell the caller that it begins."""
        self._stage = name
        self.step(0, 0)
        began = time.perf_counter()
        yield
        self.seconds[name] += time.perf_counter() - began
        logger.info("%s: %.0f ms", name, 1e3 * self.seconds[name])

    def share_wall_clock(self, wall_s: float, work_s: dict[str, float]) -> None:
        """Divide the time of stages that ran side by side in proportion to their work."""
        total_s = sum(work_s.values())
        for name, seconds in work_s.items():
            self.seconds[name] += wall_s * seconds / total_s if total_s else 0.0
            logger.info("%s: %.0f ms", name, 1e3 * self.seconds[name])

    def count(self, statuses: list[TrackStatus]) -> None:
        """Add what became of some tracks or lines."""
        self.statuses.update(statuses)

    def without_diverged(self, refined: Refined) -> Refined:
        """The lines that converged; the others are counted."""
        self.count([TrackStatus.DIVERGED] * int(refined.diverged.sum()))
        return refined.take(~refined.diverged)

    def step(self, done_count: int, total_count: int, cached_count: int = 0) -> None:
        """Tell the caller how far the current stage is."""
        begin = STAGE_BEGINS[self._stage]
        end = min((b for b in STAGE_BEGINS.values() if b > begin), default=1.0)
        share = done_count / total_count if total_count else 0.0
        # Where stages change places (`match_global`), the fraction waits.
        self._fraction = max(self._fraction, begin + share * (end - begin))
        self.progress(
            Progress(
                stage=self._stage,
                done_count=done_count,
                total_count=total_count,
                fraction=self._fraction,
                cached_count=cached_count,
            )
        )
