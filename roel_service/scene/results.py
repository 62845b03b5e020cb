"""What the jobs answer, with the status of everything that did not succeed."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from roel_service.arrays import FloatArray, frozen_array
from roel_service.geometry.se3 import SE3
from roel_service.scene.camera import Camera
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


class Verdict(Enum):
    """Whether a registration may be relied on."""

    ACCEPTED = "ACCEPTED"
    AMBIGUOUS = "AMBIGUOUS"  # another transform fits about as well
    REJECTED = "REJECTED"  # the two sides do not fit


class StopReason(Enum):
    """Why a registration came to its end."""

    CONVERGED = "CONVERGED"
    ITERATION_LIMIT = "ITERATION_LIMIT"
    NO_OVERLAP = "NO_OVERLAP"


@dataclass(frozen=True, eq=False, kw_only=True)
class Alternative:
    """Another transform that fits about as well.

    Attributes:
        T_target_source, scale, fitness: as those of the answer.
        score: as the answer's agreement.
    """

    T_target_source: SE3
    scale: float
    fitness: float
    score: float


@dataclass(frozen=True, eq=False, kw_only=True)
class RegistrationResult:
    """Where a map lies in another map: `p_target = scale * T.rotation @ p_source + T.translation`.

    Attributes:
        T_target_source: the transform.
        scale: 1 unless it was asked for.
        stop_reason: why the iterations ended.
        verdict: whether the transform may be relied on.
        inside: share of the source's samples inside the target's box, 0 to 1.
        fitness: share of the source's samples with something of the target near by, 0 to 1.
        overlap: share of the target's creases inside the source's box that a sample is near, 0 to 1.
        agreement: share of the samples on surfaces and on creases that run their way, 0 to 1.
        inlier_rmse_m: of those samples; None without any.
        information: (6, 6) inverse covariance of (r, d), target frame; None without a fit.
        weak_directions: (K, 6) unit tangents along which the transform is hardly held, with one
            radian weighted as the size of the source.
        alternatives: other transforms that fit about as well, best first.
        iteration_count: of all levels together; None where the method does not tell.
    """

    T_target_source: SE3
    scale: float = 1.0
    stop_reason: StopReason
    verdict: Verdict
    inside: float
    fitness: float
    overlap: float
    agreement: float
    inlier_rmse_m: float | None
    information: FloatArray | None
    weak_directions: FloatArray
    alternatives: tuple[Alternative, ...] = ()
    iteration_count: int | None

    def __post_init__(self) -> None:
        weak = frozen_array(self.weak_directions, np.float64, (None, 6), "weak_directions")
        object.__setattr__(self, "weak_directions", weak)
        if self.information is not None:
            information = frozen_array(self.information, np.float64, (6, 6), "information")
            object.__setattr__(self, "information", information)

    @property
    def converged(self) -> bool:
        return self.stop_reason is StopReason.CONVERGED


class PoseProblem(Enum):
    """Why refined poses are not to be relied on, or what was wrong with those given."""

    JUMPS = "JUMPS"  # the given poses jump
    TIME_OFFSET = "TIME_OFFSET"  # their clock is not that of the events
    FAR_OFF = "FAR_OFF"  # they, or the calibration, are off by far more than an odometry's


@dataclass(frozen=True, kw_only=True)
class CalibrationOffset:
    """How far off one number of a calibration is.

    Attributes:
        change: what has to be added to it, px, or to 1 for what a focal length is multiplied by.
        sigma: standard deviation of `change`; infinite where nothing tells.
        is_applied: the results are of the mended number, not of the given one.
    """

    change: float
    sigma: float
    is_applied: bool


@dataclass(frozen=True, kw_only=True)
class IntrinsicsEstimate:
    """How far off a calibration is.

    Attributes:
        focal: of both focal lengths alike.
        principal_x, principal_y: of the principal point.
        camera: the given calibration with what is applied.
    """

    focal: CalibrationOffset
    principal_x: CalibrationOffset
    principal_y: CalibrationOffset
    camera: Camera


@dataclass(frozen=True, eq=False, kw_only=True)
class PoseReport:
    """How poses were refined.

    Attributes:
        line_count: lines that held the poses.
        observation_count: their observations in use at the end.
        iteration_count: steps, over all rounds.
        converged: the last round ended because a step changed next to nothing.
        cost_initial, cost_final: mean squared distance of an observation in use, px^2, before the
            first and after the last step.
        time_offset_us, time_offset_sigma_us: what has to be added to the times of the given poses,
            and its standard deviation; infinite where nothing tells.
        intrinsics: how far off the given calibration is; none where that was not asked for.
        problems: what a caller should look at before the poses are used.
        seconds: wall-clock time of each stage.
    """

    line_count: int
    observation_count: int
    iteration_count: int
    converged: bool
    cost_initial: float
    cost_final: float
    time_offset_us: float
    time_offset_sigma_us: float
    intrinsics: IntrinsicsEstimate | None = None
    problems: tuple[PoseProblem, ...]
    seconds: dict[str, float]


@dataclass(frozen=True, eq=False, kw_only=True)
class PoseResult:
    """A trajectory after refinement.

    Attributes:
        trajectory: at the times that were given.
        covariance: (N, 6, 6) of each pose, order (r, d), rad and m, world.
    """

    trajectory: Trajectory
    covariance: FloatArray
    report: PoseReport


class PoseStatus(Enum):
    """Whether a tracked pose may be relied on."""

    TRACKING = "TRACKING"
    UNCERTAIN = "UNCERTAIN"
    LOST = "LOST"


@dataclass(frozen=True, eq=False, kw_only=True)
class TrackedPose:
    """Where the camera was at one time.

    Attributes:
        t_us: time of the pose.
        status: `UNCERTAIN` is a pose that few lines hold, that was found just now, or that does
            not go with the motion before it.
        T_world_camera: pose; None exactly when LOST.
        covariance: (6, 6) of (r, d), rad and m, world; None exactly when LOST.
        seen_share: share of the moving lines in view, by length, on which events lie.
        sharpness: density of events on those lines against that beside them; 1 by chance.
        event_count: events of the interval.
    """

    t_us: int
    status: PoseStatus
    T_world_camera: SE3 | None
    covariance: FloatArray | None
    seen_share: float
    sharpness: float
    event_count: int

    def __post_init__(self) -> None:
        if self.covariance is not None:
            covariance = frozen_array(self.covariance, np.float64, (6, 6), "covariance")
            object.__setattr__(self, "covariance", covariance)


class LocalizationStatus(Enum):
    """Whether the pose of a picture may be relied on."""

    FOUND = "FOUND"  # within 0.3 m and 15 degrees
    AMBIGUOUS = "AMBIGUOUS"  # another pose fits about as well
    NOT_FOUND = "NOT_FOUND"


class NoPoseReason(Enum):
    """Why a localization has no plain answer."""

    INSUFFICIENT_LINES = "INSUFFICIENT_LINES"
    NOT_IN_MAP = "NOT_IN_MAP"
    DEGENERATE = "DEGENERATE"
    AMBIGUOUS = "AMBIGUOUS"


@dataclass(frozen=True, eq=False, kw_only=True)
class PoseHypothesis:
    """A pose that explains a picture.

    Attributes:
        T_world_panorama: the pose.
        score: how well picture and map explain each other, 0 to 1.
        covariance: (6, 6) of (r, d), rad and m, world.
        explained_2d: share of the picture's lines that the map explains, 0 to 1.
        explained_3d: share of the map's lines in view that the picture explains, 0 to 1.
        map_index: which of the maps that were asked it is in.
    """

    T_world_panorama: SE3
    score: float
    covariance: FloatArray
    explained_2d: float
    explained_3d: float
    map_index: int = 0

    def __post_init__(self) -> None:
        covariance = frozen_array(self.covariance, np.float64, (6, 6), "covariance")
        object.__setattr__(self, "covariance", covariance)


@dataclass(frozen=True, eq=False, kw_only=True)
class PanoLocResult:
    """Where a panorama was taken.

    Attributes:
        status: whether the best pose may be relied on.
        reason: why there is no plain answer; None exactly when it was found.
        hypotheses: poses, best first; none when it was not found.
        score: that of the best pose, in the map or not.
        margin: how far, as a share of the best score, the best pose elsewhere falls behind.
        arc_count: lines in the picture.
        rotation_count: orientations that were tried, in all maps.
        candidate_count: poses that were tried, in all maps.
    """

    status: LocalizationStatus
    reason: NoPoseReason | None
    hypotheses: tuple[PoseHypothesis, ...]
    score: float
    margin: float
    arc_count: int
    rotation_count: int
    candidate_count: int

    @property
    def T_world_panorama(self) -> SE3 | None:
        return self.hypotheses[0].T_world_panorama if self.hypotheses else None
