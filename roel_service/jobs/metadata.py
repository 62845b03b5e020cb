"""What is known of an attempt, as the metadata of its operation."""

from __future__ import annotations

import time

from roel_service.jobs.task import Usage
from roel_service.progress import Progress
from roel_service.v1 import operations_pb2

# Below this share of the work an extrapolation is a guess.
MIN_ESTIMATED_SHARE = 0.02


class Metadata:
    """Grows with what is heard of the attempt.

    Args:
        attempt_count: number of the attempt, from 1.
    """

    def __init__(self, attempt_count: int) -> None:
        self._message = operations_pb2.OperationMetadata(attempt_count=attempt_count)
        self._stages: dict[str, operations_pb2.StageProgress] = {}
        self._began: tuple[float, float] | None = None

    def note_progress(self, progress: Progress) -> None:
        """A stage has got further."""
        now_s = time.monotonic()
        if progress.stage and progress.stage not in self._stages:
            self._stages[progress.stage] = self._message.stages.add(name=progress.stage)
        if progress.stage:
            stage = self._stages[progress.stage]
            stage.done_count = max(stage.done_count, progress.done_count)
            stage.total_count = max(stage.total_count, progress.total_count)
            stage.cached_count = progress.cached_count
        # What a cache answers takes no time and says nothing about the rest.
        if progress.cached_count or self._began is None:
            self._began = (now_s, progress.fraction)
        self._estimate(now_s, progress.fraction)

    def note_usage(self, usage: Usage) -> None:
        """The attempt has used more."""
        self._message.cpu_s = usage.cpu_s
        self._message.peak_rss_mib = usage.peak_rss_mib

    def note_preview(self, version_name: str) -> None:
        """A first result can be used."""
        self._message.preview_version = version_name

    def encoded(self) -> bytes:
        """The message."""
        return bytes(self._message.SerializeToString(deterministic=True))

    def _estimate(self, now_s: float, fraction: float) -> None:
        """Time left if the rest goes as fast as what was done since the attempt began."""
        if self._began is None:
            return
        began_s, began_fraction = self._began
        share = (fraction - began_fraction) / max(1.0 - began_fraction, MIN_ESTIMATED_SHARE)
        if share > MIN_ESTIMATED_SHARE:
            self._message.time_left_s = (now_s - began_s) * (1.0 - share) / share
