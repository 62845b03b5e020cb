"""Inputs of a refinement in a child; named by the front, opened in the child."""

from __future__ import annotations

from dataclasses import dataclass

from roel_service.jobs.inputs import BuildParameters
from roel_service.jobs.questions import MapFile
from roel_service.scene.trajectory import Trajectory


@dataclass(frozen=True, eq=False, kw_only=True)
class RefineParameters:
    """What to refine.

    Attributes:
        recording: events, camera, configuration, and poses to begin with.
        trajectory: takes the place of the recording's poses.
        fixed_map: holds the poses; None: lines and poses are refined together.
        makes_version: whether the lines are wanted too.
        estimate_time_offset, estimate_intrinsics: what may be off beside the poses.
    """

    recording: BuildParameters
    trajectory: Trajectory | None
    fixed_map: MapFile | None
    makes_version: bool
    estimate_time_offset: bool
    estimate_intrinsics: bool
