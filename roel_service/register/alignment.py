"""What every method hands on to be judged."""

from __future__ import annotations

from dataclasses import dataclass

from roel_service.geometry.se3 import SE3
from roel_service.scene.results import StopReason


@dataclass(frozen=True, eq=False, kw_only=True)
class Alignment:
    """A transform that a method ended at.

    Attributes:
        T_target_source: the transform.
        scale: of the source, before the transform.
        stop_reason: why the iterations ended.
        iteration_count: None where the method does not tell.
    """

    T_target_source: SE3
    scale: float = 1.0
    stop_reason: StopReason
    iteration_count: int | None
