"""One dataclass for each TOML table; field names and units are the same everywhere.

The paper's parameters and their readings are listed in `docs/paper_map.md`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any

from roel_service.errors import ConfigError

DETECTORS = ("edlines", "lsd")
REPRESENTATIONS = ("binary", "timestamp", "count", "count_sum", "tos", "sits")
PLANE_FIT_METHODS = ("vote", "ransac", "direct", "none")
MATCH_GLOBAL_METHODS = ("reassociate", "sampled", "none")
MATCHERS = ("geometric", "xfeat", "aliked", "disk", "loftr")
TRIANGULATE_GATES = ("pixel", "grassmann")
REFINE_RESIDUALS = ("pixel", "grassmann", "reprojection")
POSE_METHODS = ("smooth", "batch")
REFINE_LOSSES = ("cauchy", "squared", "quartic")
TRIM_METHODS = ("coverage", "cluster")
CURVE_METHODS = ("none", "polyline", "bezier")

# A limit that nothing reaches.
UNLIMITED = 1e6


@dataclass(frozen=True)
class Rule:
    """What a value must satisfy, and how to say so."""

    expected: str
    holds: Callable[[Any], bool]


POSITIVE = Rule("> 0", lambda value: value > 0)
NOT_NEGATIVE = Rule(">= 0", lambda value: value >= 0)
SHARE = Rule("in [0, 1]", lambda value: 0 <= value <= 1)
AT_LEAST_TWO = Rule(">= 2", lambda value: value >= 2)
UP_TO_1000 = Rule("0 to 1000", lambda value: 0 <= value <= 1000)
ALL_POSITIVE = Rule("positive values", lambda values: all(value > 0 for value in values))
PRINTABLE = Rule("printable text", lambda value: isinstance(value, str) and value.isprintable())
SOME_POSITIVE = Rule(
    "at least one value, all positive",
    lambda values: len(values) > 0 and all(value > 0 for value in values),
)


def at_most(limit: float) -> Rule:
    """A positive number up to a limit that keeps time and memory of a run bounded."""
    return Rule(f"> 0 and <= {limit:g}", lambda value: 0 < value <= limit)


def one_of(names: tuple[str, ...]) -> Rule:
    """The value is one of these names."""
    return Rule("one of " + ", ".join(names), lambda value: value in names)


def some_of(names: tuple[str, ...]) -> Rule:
    """Every value is one of these names, and there is at least one."""
    expected = "at least one of " + ", ".join(names)
    return Rule(expected, lambda values: len(values) > 0 and all(v in names for v in values))


def parameter(default: Any, rule: Rule) -> Any:
    """A field with its default and its range."""
    return field(default=default, metadata={"rule": rule})


class Stage:
    """Base of the tables: checks every field's rule, and names the table in errors."""

    table: str

    def __init_subclass__(cls, *, table: str) -> None:
        cls.table = table

    def __post_init__(self) -> None:
        for item in fields(self):  # type: ignore[arg-type]  # every subclass is a dataclass
            value = getattr(self, item.name)
            rule = item.metadata.get("rule")
            numbers = value if isinstance(value, tuple) else (value,)
            finite = all(math.isfinite(x) for x in numbers if isinstance(x, float))
            if rule is not None and not (finite and rule.holds(value)):
                path = f"{self.table}.{item.name}"
                raise ConfigError(path, rule.expected, repr(value))


@dataclass(frozen=True, kw_only=True)
class FramesConfig(Stage, table="frames"):
    """When lines are looked for, and how events are brought to that time.

    Attributes:
        rate_hz: frames a second.
        min_frame_count: a shorter recording gets more frames a second, to have this many.
        compensate_rotation: undo the camera's rotation within a frame, by the poses.
        slot_us: events of one slot share one pose.
        min_half_window_us, max_half_window_us: bounds of every window around a frame's time.
    """

    rate_hz: float = parameter(30.0, at_most(1000))
    min_frame_count: int = parameter(24, at_most(1000))
    compensate_rotation: bool = True
    slot_us: int = parameter(500, POSITIVE)
    min_half_window_us: int = parameter(6_000, POSITIVE)
    max_half_window_us: int = parameter(25_000, POSITIVE)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.min_half_window_us > self.max_half_window_us:
            expected = f"<= max_half_window_us = {self.max_half_window_us}"
            raise ConfigError("frames.min_half_window_us", expected, f"{self.min_half_window_us}")


@dataclass(frozen=True, kw_only=True)
class DetectConfig(Stage, table="detect"):
    """Multi-window, multi-representation line detection.

    Attributes:
        detector: 2D line detector.
        representations: images made of every window; `timestamp`, `count` and `sits` are one a
            polarity, `tos` and `sits` the surfaces that the paper compares with.
        window_events_per_pixel: window sizes, in events for each pixel of the sensor.
        window_event_counts: window sizes in events; takes the place of the former if not empty.
        blur_px: standard deviation of the Gaussian that images are smoothed with.
        gradient_threshold, anchor_threshold: of EDLines, in grey values.
        line_fit_error_px: largest distance of an edge chain from its line.
        min_length_px, min_length_width_share: shortest line, the larger of px and share of width.
        merge_distance_px, merge_overlap: a line closer than this (perpendicular) to a longer one
            over at least this share of its length is the same line.
        merge_across_polarities: lines of images of either polarity, or of both, may be the same;
            their polarity is then unknown.
    """

    detector: str = parameter("edlines", one_of(DETECTORS))
    representations: tuple[str, ...] = parameter(("count_sum",), some_of(REPRESENTATIONS))
    window_events_per_pixel: tuple[float, ...] = parameter((0.1, 0.3), SOME_POSITIVE)
    window_event_counts: tuple[int, ...] = parameter((), ALL_POSITIVE)
    blur_px: float = parameter(1.0, NOT_NEGATIVE)
    gradient_threshold: int = parameter(12, POSITIVE)
    anchor_threshold: int = parameter(4, NOT_NEGATIVE)
    line_fit_error_px: float = parameter(1.2, POSITIVE)
    min_length_px: float = parameter(10.0, POSITIVE)
    min_length_width_share: float = parameter(0.0219, SHARE)
    merge_distance_px: float = parameter(1.0, NOT_NEGATIVE)
    merge_overlap: float = parameter(0.8, SHARE)
    merge_across_polarities: bool = False


@dataclass(frozen=True, kw_only=True)
class PlaneFitConfig(Stage, table="plane_fit"):
    """Space-time planes through the events near each detected line.

    Attributes:
        method: `vote` (speed vote, then robust least squares), `ransac` (the paper's), `direct`
            (the same for clusters of events, without detected lines) or `none` (lines stay as they
            were detected, without events).
        candidate_distance_px: events this close to the detected line are candidates.
        extension_px: candidates may lie this far beyond the ends (`vote`).
        time_scale_px_per_ms: length of a millisecond in the paper's plane distance (`ransac`).
        trial_count: random planes a line (`ransac`; ten times as many a cluster for `direct`).
        inlier_distance_px: a candidate this close to the plane supports it.
        min_inlier_count: fewer supporting events give no line.
        max_speed_widths_per_s, speed_count: range and steps of the vote on the normal speed.
        support_bin_px, max_gap_bin_count: the supported run of the line, in bins with few gaps.
        min_occupancy: least share of the run's bins that hold events.
        min_density_ratio: least density of events on the line against beside it.
        duplicate_distance_px, duplicate_overlap: of two fits this close, the better one stays.
        support_event_count: supporting events kept a line, nearest in time to the frame.
        support_half_window_us: supporting events are no farther in time from the frame.
        cluster_distance_px, cluster_time_scale_px_per_ms, cluster_min_event_count: radius, length
            of a millisecond and least number of events of the clusters' DBSCAN (`direct`).
    """

    method: str = parameter("vote", one_of(PLANE_FIT_METHODS))
    candidate_distance_px: float = parameter(5.0, POSITIVE)
    extension_px: float = parameter(24.0, NOT_NEGATIVE)
    time_scale_px_per_ms: float = parameter(20.0, POSITIVE)
    trial_count: int = parameter(64, at_most(10_000))
    inlier_distance_px: float = parameter(0.8, POSITIVE)
    min_inlier_count: int = parameter(10, POSITIVE)
    max_speed_widths_per_s: float = parameter(0.5625, POSITIVE)
    speed_count: int = parameter(25, Rule("2 to 1000", lambda value: 2 <= value <= 1000))
    support_bin_px: float = parameter(3.0, Rule(">= 0.1", lambda value: value >= 0.1))
    max_gap_bin_count: int = parameter(3, NOT_NEGATIVE)
    min_occupancy: float = parameter(0.6, SHARE)
    min_density_ratio: float = parameter(1.6, NOT_NEGATIVE)
    duplicate_distance_px: float = parameter(1.3, NOT_NEGATIVE)
    duplicate_overlap: float = parameter(0.6, SHARE)
    support_event_count: int = parameter(400, at_most(100_000))
    support_half_window_us: int = parameter(12_000, POSITIVE)
    cluster_distance_px: float = parameter(3.0, Rule(">= 0.1", lambda value: value >= 0.1))
    cluster_time_scale_px_per_ms: float = parameter(1.0, at_most(1000))
    cluster_min_event_count: int = parameter(4, POSITIVE)


@dataclass(frozen=True, kw_only=True)
class MatchLocalConfig(Stage, table="match_local"):
    """Mutual nearest lines of neighbouring frames.

    Attributes:
        predict: move a line by its speed and the camera's rotation before comparing.
        max_distance_px: largest distance between the lines.
        min_overlap: share of the shorter line that must face the other.
        reach_frame_count: how many frames ago a track may have been seen last; 1 links
            neighbouring frames alone.
    """

    predict: bool = True
    max_distance_px: float = parameter(2.5, POSITIVE)
    min_overlap: float = parameter(0.3, SHARE)
    reach_frame_count: int = parameter(1, POSITIVE)


@dataclass(frozen=True, kw_only=True)
class MatchGlobalConfig(Stage, table="match_global"):
    """Lines of distant frames: by sampled frame pairs, or by projecting triangulated lines.

    Attributes:
        method: `sampled` joins tracks that correspond in sampled frames (the paper's scheme);
            `reassociate` projects triangulated lines into every frame, in rounds; `none` leaves
            the tracks of neighbouring frames as they are.
        frame_stride, neighbor_count: every how many frames, and against how many others, nearest
            by camera centre (`sampled`).
        matcher: finds correspondences (`sampled`): `geometric` by projecting provisional lines, the
            others by learned point matches between event images (extra `learned`).
        checkpoint: file with the weights of `loftr`; empty for none.
        min_point_match_count, point_distance_px: two lines correspond when so many point matches
            lie this close to both (learned matchers).
        min_epipolar_score: epipolar intersection over union of a correspondence (`sampled`).
        max_distances_px: distance of an observation from the projected line, one value a round;
            the first one serves `sampled`.
        min_overlap: share of an observation that must face the projected line.
        max_speed_difference_px_per_ms: observed against predicted normal speed.
        max_shared_fraction: of two lines that share more observations, the weaker one goes; 1
            keeps both.
        one_side: a line keeps to observations that see its bright side where most of them do
            (`reassociate`).
    """

    method: str = parameter("reassociate", one_of(MATCH_GLOBAL_METHODS))
    frame_stride: int = parameter(5, POSITIVE)
    neighbor_count: int = parameter(20, POSITIVE)
    matcher: str = parameter("geometric", one_of(MATCHERS))
    checkpoint: str = parameter("", PRINTABLE)
    min_point_match_count: int = parameter(11, POSITIVE)
    point_distance_px: float = parameter(10.0, POSITIVE)
    min_epipolar_score: float = parameter(0.3, SHARE)
    max_distances_px: tuple[float, ...] = parameter((1.5, 1.1, 1.1), SOME_POSITIVE)
    min_overlap: float = parameter(0.3, SHARE)
    max_speed_difference_px_per_ms: float = parameter(0.04, POSITIVE)
    max_shared_fraction: float = parameter(0.97, SHARE)
    one_side: bool = True

    @property
    def matches_points(self) -> bool:
        """Whether correspondences come from point matches, which need the event images."""
        return self.method == "sampled" and self.matcher != "geometric"


@dataclass(frozen=True, kw_only=True)
class TriangulateConfig(Stage, table="triangulate"):
    """RANSAC over pairs of views, and merging of duplicates.

    Attributes:
        gate: inliers by `pixel` distance, or by the `grassmann` angle and four segment distances.
        min_observation_count: shorter tracks are not tried.
        pair_count, scored_observation_count: hypotheses a track, and observations they meet.
        min_plane_angle_deg: smallest angle between the two viewing planes of a hypothesis.
        max_residual_px: of an inlier's ends (`pixel`).
        max_grassmann_angle_deg: principal angle between viewing plane and line (`grassmann`).
        max_angle_3d_deg, max_angle_2d_deg, max_perpendicular_px, max_perspective: the segment
            distances of the paper's reference [LIMAP] (`grassmann`).
        min_inlier_count: fewer inliers give no line.
        iteration_count: Gauss-Newton steps over the inliers, with the cost of `refine` for `pixel`,
            with the line term alone and equal weights for `grassmann`; 0 keeps the hypothesis.
        merge: cluster lines by DBSCAN and keep the longest of each cluster.
        merge_angle_deg, merge_disparity_px, merge_center_px: what counts as one in each part of
            the clustering space.
    """

    gate: str = parameter("pixel", one_of(TRIANGULATE_GATES))
    min_observation_count: int = parameter(3, AT_LEAST_TWO)
    pair_count: int = parameter(60, at_most(1000))
    scored_observation_count: int = parameter(
        40, Rule("2 to 1000", lambda value: 2 <= value <= 1000)
    )
    min_plane_angle_deg: float = parameter(0.4, POSITIVE)
    max_residual_px: float = parameter(2.5, POSITIVE)
    max_grassmann_angle_deg: float = parameter(1.4, POSITIVE)
    max_angle_3d_deg: float = parameter(10.0, POSITIVE)
    max_angle_2d_deg: float = parameter(5.0, POSITIVE)
    max_perpendicular_px: float = parameter(2.0, POSITIVE)
    max_perspective: float = parameter(0.015, POSITIVE)
    min_inlier_count: int = parameter(3, AT_LEAST_TWO)
    iteration_count: int = parameter(8, UP_TO_1000)
    merge: bool = False
    merge_angle_deg: float = parameter(2.0, POSITIVE)
    merge_disparity_px: float = parameter(2.0, POSITIVE)
    merge_center_px: float = parameter(20.0, POSITIVE)


@dataclass(frozen=True, kw_only=True)
class RefineRoundsConfig(Stage, table="refine_rounds"):
    """Least squares over lines while they still collect observations.

    After triangulation and between the rounds of re-association. The last refinement has the same
    parameters in a table of its own, so that who changes it need not have the lines found again.

    Attributes:
        residual: `pixel` (both terms as angles times focal length), `grassmann` (as published) or
            `reprojection` (the observed ends' distances from the line's image, as LIMAP does).
        loss: `cauchy`, `squared` (none) or `quartic` (the square of each squared residual: the
            other reading of the published cost).
        loss_scale_px: residual at which the Cauchy loss starts to bend, at the least.
        loss_scale_medians: the same in medians of the residuals of all inliers, so that it widens
            where a recording is worse than that; 0 leaves it as it is.
        event_weight: weight of the event term against the line term; its unit follows `residual`.
        max_length_weight_px: observations longer than this weigh no more.
        direction_sigma_deg: how far lines deviate from a direction that many of them share; 0
            refines every line on its own.
        direction_noise_px: noise of an observation as a whole, against directions and corners.
        max_direction_distance: a line this many standard deviations from a shared direction, or
            fewer, is held to it.
        iteration_count: Gauss-Newton steps at the most; 0 leaves the lines as they are.
        max_residual_px: observations beyond it are left out of the next step.
        min_inlier_count: a line with fewer has diverged.
    """

    residual: str = parameter("pixel", one_of(REFINE_RESIDUALS))
    loss: str = parameter("cauchy", one_of(REFINE_LOSSES))
    loss_scale_px: float = parameter(0.5, POSITIVE)
    loss_scale_medians: float = parameter(0.0, NOT_NEGATIVE)
    event_weight: float = parameter(1.0, NOT_NEGATIVE)
    max_length_weight_px: float = parameter(60.0, POSITIVE)
    direction_sigma_deg: float = parameter(0.5, Rule("in [0, 10]", lambda value: 0 <= value <= 10))
    direction_noise_px: float = parameter(0.3, POSITIVE)
    max_direction_distance: float = parameter(3.0, POSITIVE)
    iteration_count: int = parameter(8, UP_TO_1000)
    max_residual_px: float = parameter(2.0, POSITIVE)
    min_inlier_count: int = parameter(3, AT_LEAST_TWO)


@dataclass(frozen=True, kw_only=True)
class RefineConfig(RefineRoundsConfig, table="refine"):
    """Joint least squares over the line term and the event term: the last refinement.

    Attributes:
        residual: `pixel` (both terms as angles times focal length), `grassmann` (as published) or
            `reprojection` (the observed ends' distances from the line's image, as LIMAP does).
        loss: `cauchy`, `squared` (none) or `quartic` (the square of each squared residual: the
            other reading of the published cost).
        loss_scale_px: residual at which the Cauchy loss starts to bend, at the least.
        loss_scale_medians: the same in medians of the residuals of all inliers, so that it widens
            where a recording is worse than that; 0 leaves it as it is.
        event_weight: weight of the event term against the line term; its unit follows `residual`.
        event_count_per_line: supporting events used an observation, nearest in time; 0 uses all.
            Events are summed up where lines are found in frames, so that this one is read there.
        max_length_weight_px: observations longer than this weigh no more.
        direction_sigma_deg: how far lines deviate from a direction that many of them share; 0
            refines every line on its own.
        direction_noise_px: noise of an observation as a whole, against directions and corners.
        max_direction_distance: a line this many standard deviations from a shared direction, or
            fewer, is held to it.
        iteration_count: Gauss-Newton steps at the most; 0 leaves the lines as triangulated.
        max_residual_px: observations beyond it are left out of the next step.
        min_inlier_count: a line with fewer has diverged.
        corner_sigma_m: how far lines pass by the corners that they end at; 0 leaves corners alone.
        corner_distance_px: the end of a line and a corner this close, as its cameras see them, are
            one.
        corner_depth_m: lines known better than this end at corners; lines known worse are held to
            corners that agree about their depth within this.
        free_poses: refine the poses together with the lines, then map with the refined ones.
        pose_method: `smooth` (a smooth correction of the given poses, in rounds with matching) or
            `batch` (as published: one free pose a frame, with lines triangulated once; the residual
            is `grassmann` or `reprojection`).
        pose_rate_hz: frames a second that poses are refined with at a focal length of 440 px, more with a
            shorter one, which sees angles less sharply; `frames.rate_hz` at the most.
        pose_gates_px: with free poses, distance within which lines take up observations, one value
            a round of matching and refinement; a round is repeated while lines still move.
        pose_turn_deg: how far the given poses may be turned against one another; the first gates are
            widened to what that moves in the picture.
        pose_iteration_count: Gauss-Newton steps of lines and poses at the most, each round.
        pose_interval_us: control points of the poses' correction are so far apart.
        pose_loss_scale_px: residual at which the Cauchy loss of lines and poses starts to bend, at the
            last gate.
        pose_noise_px: noise of an observation as a whole, against the drift of the poses.
        pose_drift_deg, pose_drift_m: how far the given poses are expected to wander off, standard
            deviations; how far they did is learned from there.
        pose_drift_s: the time after which they have forgotten it.
    """

    loss_scale_px: float = parameter(0.35, POSITIVE)
    event_count_per_line: int = parameter(0, NOT_NEGATIVE)
    corner_sigma_m: float = parameter(0.02, NOT_NEGATIVE)
    corner_distance_px: float = parameter(5.0, POSITIVE)
    corner_depth_m: float = parameter(0.03, POSITIVE)
    free_poses: bool = False
    pose_method: str = parameter("smooth", one_of(POSE_METHODS))
    pose_rate_hz: float = parameter(25.0, at_most(1000))
    pose_gates_px: tuple[float, ...] = parameter((3.0, 2.0, 1.3), SOME_POSITIVE)
    pose_turn_deg: float = parameter(0.78, POSITIVE)
    pose_iteration_count: int = parameter(6, UP_TO_1000)
    pose_interval_us: int = parameter(100_000, POSITIVE)
    pose_loss_scale_px: float = parameter(0.15, POSITIVE)
    pose_noise_px: float = parameter(0.15, POSITIVE)
    pose_drift_deg: float = parameter(0.25, POSITIVE)
    pose_drift_m: float = parameter(0.005, POSITIVE)
    pose_drift_s: float = parameter(1.5, POSITIVE)

    def require_more_than_poses(self) -> None:
        """Raise `ConfigError` unless a time offset or intrinsics may be estimated beside the poses."""
        if self.pose_method == "batch":
            expected = "smooth, where a time offset or intrinsics are estimated"
            raise ConfigError("refine.pose_method", expected, self.pose_method)


@dataclass(frozen=True, kw_only=True)
class TrimConfig(Stage, table="trim"):
    """Infinite lines cut to the segments that were seen, and lines that cannot be trusted.

    Attributes:
        method: `coverage` (runs seen by enough frames, gaps stay gaps) or `cluster` (two ends
            from clustered candidates, as published).
        max_gap_m, min_length_m: bridged gap (`coverage`) and shortest segment.
        min_pixel_gap_px: gaps below this many pixels at the viewing distance are bridged too.
        min_coverage_count, min_coverage_fraction: frames that must have seen a bin, absolute and
            against the best bin.
        max_foreshortening: views in which a line looks this many times shorter than it is, nearly
            end on, do not count (`coverage`).
        end_cluster_px: two candidates this close, at the viewing distance, are one end (`cluster`).
        max_error_m: largest error to expect of an end across the line: its standard deviation for
            the line's own residual, over the share of the frames that saw it of those that could.
        overlap_distance_m, overlap_angle_deg: parts this close to a stronger line are cut away; a
            distance of 0 leaves them.
    """

    method: str = parameter("coverage", one_of(TRIM_METHODS))
    max_gap_m: float = parameter(0.03, NOT_NEGATIVE)
    min_length_m: float = parameter(0.03, POSITIVE)
    min_pixel_gap_px: float = parameter(3.0, NOT_NEGATIVE)
    min_coverage_count: int = parameter(4, POSITIVE)
    min_coverage_fraction: float = parameter(0.25, SHARE)
    max_foreshortening: float = parameter(5.0, Rule(">= 1", lambda value: value >= 1))
    end_cluster_px: float = parameter(5.0, POSITIVE)
    max_error_m: float = parameter(0.06, POSITIVE)
    overlap_distance_m: float = parameter(0.0, NOT_NEGATIVE)
    overlap_angle_deg: float = parameter(4.0, NOT_NEGATIVE)


@dataclass(frozen=True, kw_only=True)
class RegisterConfig(Stage, table="register"):
    """Maps laid onto point clouds.

    Attributes:
        voxel_m: clouds are thinned to one point in each cube of this size.
        max_distance_m: a sample of the map with a point of the cloud this close counts as fitting.
        reach_m, reach_deg: how far off a first guess may be.
        gravity_aligned: whether z is vertical on both sides; `global` then looks for a heading only.
        estimate_scale: whether the map's unit is unknown, as that of poses from one camera is.
        last_scale_m: error beyond which a sample hardly counts in the end.
        step_count: at most so many steps of the last level.
        candidate_count: guesses that are followed up, the best first.
        min_inside: a smaller share of the map inside the cloud's box is no registration.
        min_fitness: nor is a smaller share of fitting samples; more is asked where little is inside.
        min_agreement: nor is one whose lines agree less, inside, with surfaces and creases.
        ambiguity_ratio: another transform that agrees at least so well against the best is a rival.
        sample_spacing_m: spacing of the points along lines of method `point`.
        point_gate_m: pairs of method `point` farther apart than this do not count.
        point_iteration_count: at most so many iterations of method `point`.
    """

    voxel_m: float = parameter(0.02, POSITIVE)
    max_distance_m: float = parameter(0.05, POSITIVE)
    reach_m: float = parameter(0.5, POSITIVE)
    reach_deg: float = parameter(40.0, at_most(180))
    gravity_aligned: bool = True
    estimate_scale: bool = False
    last_scale_m: float = parameter(0.01, POSITIVE)
    step_count: int = parameter(20, UP_TO_1000)
    candidate_count: int = parameter(8, at_most(1000))
    min_inside: float = parameter(0.3, SHARE)
    min_fitness: float = parameter(0.6, SHARE)
    min_agreement: float = parameter(0.42, SHARE)
    ambiguity_ratio: float = parameter(0.85, SHARE)
    sample_spacing_m: float = parameter(0.005, POSITIVE)
    point_gate_m: float = parameter(0.5, POSITIVE)
    point_iteration_count: int = parameter(100, UP_TO_1000)


@dataclass(frozen=True, kw_only=True)
class LocalizeConfig(Stage, table="localize"):
    """Panoramas located in maps.

    Attributes:
        max_width_px: larger panoramas are made this wide first.
        crop_px: side of the perspective crops in which lines are looked for.
        min_arc_deg: shortest line of a panorama, as an angle.
        max_arc_count: longest lines of a panorama that are used.
        grid_step_m: spacing of the places that are tried first.
        max_rotation_count: orientations that are tried, best first.
        candidate_count: poses whose neighbourhood is searched.
        max_hypothesis_count: poses at the most in an answer.
        min_score: a pose that explains less of picture and map together is none; a fifth of its
            margin is added, and fewer lines in the picture ask for more.
        min_coverage: nor is one at which the picture shows less of the map's lines.
        min_margin: a runner-up this close below the best pose, as a share of its score, leaves the
            answer open.
    """

    max_width_px: int = parameter(2048, Rule("512 to 8192", lambda value: 512 <= value <= 8192))
    crop_px: int = parameter(272, Rule("64 to 1024", lambda value: 64 <= value <= 1024))
    min_arc_deg: float = parameter(2.0, at_most(45))
    max_arc_count: int = parameter(500, at_most(5000))
    grid_step_m: float = parameter(0.3, POSITIVE)
    max_rotation_count: int = parameter(64, at_most(1000))
    candidate_count: int = parameter(72, at_most(1000))
    max_hypothesis_count: int = parameter(5, Rule("1 to 5", lambda value: 1 <= value <= 5))
    min_score: float = parameter(0.2, SHARE)
    min_coverage: float = parameter(0.06, SHARE)
    min_margin: float = parameter(0.12, SHARE)


@dataclass(frozen=True, kw_only=True)
class TrackConfig(Stage, table="track"):
    """Poses of a moving camera in a map that is there already.

    Attributes:
        interval_us: a pose is told so often, from the events of that time.
        max_event_count: events of an interval that are used; of more, every n-th.
        reach_m, reach_deg: how far off the first pose may be, and the last one after a loss.
        acceleration_m_s2, turn_acceleration_deg_s2: how the camera's motion changes, standard
            deviations.
        event_noise_px: of one event across its line.
        line_noise_px, line_noise_m: of a line as a whole, in the picture and in the map; what it
            has of both does not go away with more events.
        min_seen_share: share of the moving lines in view on which events must be.
        min_sharpness: density of events on the lines against that beside them.
        max_sigma_m, max_sigma_deg: a pose that is known no better than this is uncertain.
    """

    interval_us: int = parameter(25_000, Rule("2000 to 100000", lambda v: 2000 <= v <= 100_000))
    max_event_count: int = parameter(8_000, Rule("100 to 10^6", lambda v: 100 <= v <= 1_000_000))
    reach_m: float = parameter(0.2, POSITIVE)
    reach_deg: float = parameter(10.0, at_most(45))
    acceleration_m_s2: float = parameter(3.0, POSITIVE)
    turn_acceleration_deg_s2: float = parameter(200.0, POSITIVE)
    event_noise_px: float = parameter(0.7, POSITIVE)
    line_noise_px: float = parameter(0.3, POSITIVE)
    line_noise_m: float = parameter(0.0013, POSITIVE)
    min_seen_share: float = parameter(0.6, SHARE)
    min_sharpness: float = parameter(20.0, POSITIVE)
    max_sigma_m: float = parameter(0.012, POSITIVE)
    max_sigma_deg: float = parameter(0.5, POSITIVE)


@dataclass(frozen=True, kw_only=True)
class RuntimeConfig(Stage, table="runtime"):
    """How the work is done; nothing but speed depends on it, except for the seed.

    Attributes:
        seed: fixes all randomness.
        worker_count: threads of the front end; 0 takes one a core.
    """

    seed: int = parameter(0, NOT_NEGATIVE)
    worker_count: int = parameter(0, Rule("0 to 256", lambda value: 0 <= value <= 256))


@dataclass(frozen=True, kw_only=True)
class CurvesConfig(Stage, table="curves"):
    """Curved edges as polylines, beside the lines of the map.

    Attributes:
        method: `none`, or what a chain of points is fitted as before it is cut into segments:
            `polyline` or `bezier`, a cubic curve.
        piece_length_px: edges are cut into pieces of about this length, five pixels at the least.
        frame_stride: chains are looked for in every so many of the frames that have pieces.
        reach_frame_count: how many frames before and behind say how deep a point lies.
        max_distance_px: of a point's image from a piece.
        min_frame_count: frames that saw a point.
        min_support_ratio: frames that saw a point against frames that could have.
        max_rms_px: largest residual of a point.
        max_sigma_m: largest standard deviation of a point across the curve.
        max_error_px: of the segments from the curve, at the viewing distance.
        overlap_distance_px: what lies this close along a line, or along a curve that more frames
            saw, is left out.
    """

    method: str = parameter("none", one_of(CURVE_METHODS))
    piece_length_px: float = parameter(10.0, POSITIVE)
    frame_stride: int = parameter(3, POSITIVE)
    reach_frame_count: int = parameter(36, at_most(1000))
    max_distance_px: float = parameter(2.0, POSITIVE)
    min_frame_count: int = parameter(8, POSITIVE)
    min_support_ratio: float = parameter(0.6, SHARE)
    max_rms_px: float = parameter(0.6, POSITIVE)
    max_sigma_m: float = parameter(0.1, POSITIVE)
    max_error_px: float = parameter(0.6, POSITIVE)
    overlap_distance_px: float = parameter(2.5, NOT_NEGATIVE)


# Tables of what is done with a finished map: they cannot change one.
AFTER_MAPPING = ("register", "localize", "track")


@dataclass(frozen=True, kw_only=True)
class Config:
    """Every parameter of a run, one attribute for each TOML table."""

    frames: FramesConfig = FramesConfig()
    detect: DetectConfig = DetectConfig()
    plane_fit: PlaneFitConfig = PlaneFitConfig()
    match_local: MatchLocalConfig = MatchLocalConfig()
    match_global: MatchGlobalConfig = MatchGlobalConfig()
    triangulate: TriangulateConfig = TriangulateConfig()
    refine: RefineConfig = RefineConfig()
    trim: TrimConfig = TrimConfig()
    register: RegisterConfig = RegisterConfig()
    runtime: RuntimeConfig = RuntimeConfig()
    curves: CurvesConfig = CurvesConfig()
    localize: LocalizeConfig = LocalizeConfig()
    refine_rounds: RefineRoundsConfig = RefineRoundsConfig()
    track: TrackConfig = TrackConfig()
