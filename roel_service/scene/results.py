"""What the jobs answer, with the status of everything that did not succeed."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from roel_service.scene.lines import LineMap
from roel_service.scene.trajectory import Trajectory


class TrackStatus(Enum):
    """What became of one track of 2D lines."""

    TRIANGULATED = "triangulated"
    TOO_FEW_VIEWS = "too_few_views"
    LOW_PARALLAX = "low_parallax"
    TOO_FEW_INLIERS = "too_few_inliers"
    DIVERGED = "diverged"
    MERGED = "merged"
    UNCERTAIN = "uncertain"
    POOR_FIT = "poor_fit"
    UNSUPPORTED = "unsupported"
    TOO_SHORT = "too_short"


# The stages of mapping, in their order; names of the TOML tables and of the report's seconds.
MAPPING_STAGES = (
    "detect",
    "plane_fit",
    "match_local",
    "match_global",
    "triangulate",
    "refine",
    "trim",
)


@dataclass(frozen=True, eq=False, kw_only=True)
class MappingReport:
    """How a map came about.

    Attributes:
        frame_count: frames in which lines were looked for.
        event_count: events used.
        left_out_event_count: events outside the poses or in a gap of them.
        observation_count: 2D lines that passed the plane fit.
        track_status_count: how many tracks, or pieces of lines, ended in each status.
        seconds: wall-clock time of each of `MAPPING_STAGES`.
    """

    frame_count: int
    event_count: int
    left_out_event_count: int
    observation_count: int
    track_status_count: dict[TrackStatus, int]
    seconds: dict[str, float]


@dataclass(frozen=True, eq=False, kw_only=True)
class MappingResult:
    """A line map with the trajectory it belongs to."""

    line_map: LineMap
    trajectory: Trajectory
    report: MappingReport
