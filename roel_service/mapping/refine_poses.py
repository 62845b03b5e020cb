"""Noisy poses made good by the lines that they see.

Paper: "Pose Refinement". The published batch optimisation moves the poses of triangulated lines
once (`batch_poses`); here matching and joint refinement take turns while the gates close, so that
poses that are too poor for the right matches get better ones.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.config.stages import Config, RefineConfig, RefineRoundsConfig
from roel_service.geometry import plucker
from roel_service.geometry.alignment import align_poses, as_large_as
from roel_service.geometry.se3 import SE3
from roel_service.mapping import intrinsics_search
from roel_service.mapping.batch_poses import refine_poses_at_once
from roel_service.mapping.detect import line_detector
from roel_service.mapping.directions import direction_prior
from roel_service.mapping.evidence import Evidence
from roel_service.mapping.first_lines import check_line_count
from roel_service.mapping.frames import Frames
from roel_service.mapping.front_end import Detected, lines_of_all_frames, worker_count
from roel_service.mapping.joint import FEIGNED_DRIFT, JointlyRefined, refine_jointly
from roel_service.mapping.match_global import match_fixed_lines, reassociate
from roel_service.mapping.match_local import match_adjacent_frames
from roel_service.mapping.pose_correction import Drift, PoseCorrection
from roel_service.mapping.pose_jumps import pose_jumps
from roel_service.mapping.pose_windows import laid_over, pose_windows, seen_between
from roel_service.mapping.refine import Refined, refine_lines
from roel_service.mapping.run import CountedEvents, MappingRun
from roel_service.mapping.smooth_poses import smoothed
from roel_service.mapping.time_offset import TimeOffset, mean_offset, time_offset
from roel_service.mapping.triangulate import triangulate_tracks
from roel_service.mapping.views import views_of
from roel_service.progress import ProgressCallback, ignore, part_of
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventSource
from roel_service.scene.lines import InfiniteLines, LineMap
from roel_service.scene.results import (
    MAPPING_STAGES,
    IntrinsicsEstimate,
    PoseProblem,
    PoseReport,
    PoseResult,
)
from roel_service.scene.trajectory import Trajectory

logger = logging.getLogger(__name__)

Costs = TypeVar("Costs", bound=RefineRoundsConfig)

# The first gates in a given map are so much wider than those of a recording's own lines: its world
# and that of the poses need not be quite the same.
MAP_GATES = (4.0, 2.0)
# A gate closes once a round has moved the lines in the pictures by less than this share of it: else others
# would have matched. So many rounds are enough.
SETTLED_SHARE = 0.05
MAX_ROUND_COUNT = 3
# The focal length that the frames' rate is configured for.
RATE_FOCAL_PX = 440.0
# While the gate is wide, residuals up to this share of it count in full.
FULL_WEIGHT_SHARE = 0.1
# A time offset that is smaller, or less sure, is none; and it is estimated so many times at the most.
LEAST_OFFSET_US, OFFSET_SIGMA_COUNT = 4_000.0, 4.0
MAX_OFFSET_COUNT = 3
# Of the time, if what is wrong with the calibration is looked for.
INTRINSICS_SHARE = 0.9
# So many refinements tell that a calibration is right.
USUAL_COST_COUNT = 13
# A focal length that is off by a smaller share is not told: noisy poses alone may feign .7 %.
LEAST_FOCAL_SHARE = 0.015
# A drift that is learned to be so many times larger than expected is none of an odometry.
FAR_FACTOR = 3.0
PROBLEMS = {
    PoseProblem.JUMPS: "the given poses jump",
    PoseProblem.TIME_OFFSET: "their clock is not that of the events; it can be estimated",
    PoseProblem.FAR_OFF: "they, or the calibration, are off by more than an odometry's drift",
}
# Beyond the first gate: what noisy poses add between two frames, and over a whole track.
MATCH_MARGIN_PX = 0.5
TRACK_MARGIN_PX = 1.0


@dataclass(frozen=True, eq=False, kw_only=True)
class _Found:
    """What was found in one window of a recording.

    Attributes:
        window: the poses of the window, among all.
        given: the trajectory that was refined, on the clock of the events.
        smooth: the same without jitter.
        refined: lines with their tracks.
        rounds: of matching and refinement.
    """

    window: slice
    given: Trajectory
    smooth: Trajectory
    refined: Refined
    rounds: list[JointlyRefined]

    @property
    def last(self) -> JointlyRefined:
        return self.rounds[-1]

    @property
    def time_offset(self) -> TimeOffset:
        """That is still left."""
        return time_offset(self.last, self.smooth)


def refine_poses(
    events: EventSource,
    trajectory: Trajectory,
    camera: Camera,
    config: Config,
    *,
    line_map: LineMap | None = None,
    estimate_time_offset: bool = False,
    estimate_intrinsics: bool = False,
    progress: ProgressCallback = ignore,
) -> PoseResult:
    """Refine the poses of a recording, together with the lines that it sees or in a given map.

    Without a map only the given poses tell where the world is: the result is aligned to them, and
    as large as they are.

    Args:
        events: read front to back, again for every estimate of the time offset, and for every
            calibration that is tried.
        trajectory: poses on the clock of the events.
        camera: calibration of the sensor.
        config: parameters of every stage; those of the poses are in `refine`.
        line_map: lines that stay as they are; the given poses are roughly those in its world. What
            finds poses there is the smooth correction, whichever method is configured.
        estimate_time_offset: whether the clock of the poses may run beside that of the events; the
            result is on the latter, at the times that were given.
        estimate_intrinsics: whether focal length and principal point may be off. They are looked for
            with the given clock, by some fourteen refinements, or twice or three times as many if they are.
        progress: called often; may raise `Cancelled`.

    Raises:
        ConfigError: the published batch (`refine.pose_method`) is to estimate more than poses.
        EventsError: no events.
        TrajectoryError: poses that cover less than a tenth of the recording.
        LimitError: RECORDING_TOO_LONG, a gap in the poses that is longer than can be refined at once.
        NoAnswerError: too few lines.
        Cancelled: as raised by `progress`.
    """
    if config.refine.pose_method == "batch" and line_map is None:
        if estimate_time_offset or estimate_intrinsics:
            config.refine.require_more_than_poses()
        return refine_poses_at_once(events, trajectory, camera, config, progress)
    seconds = dict.fromkeys(MAPPING_STAGES, 0.0)
    intrinsics = None
    if estimate_intrinsics:
        searching = part_of(progress, 0.0, INTRINSICS_SHARE)
        progress = part_of(progress, INTRINSICS_SHARE, 1.0)
        intrinsics = _intrinsics(events, trajectory, camera, config, line_map, seconds, searching)
        camera = intrinsics.camera
    applied_us = 0
    count = MAX_OFFSET_COUNT if estimate_time_offset else 1
    for index in range(count):
        run = MappingRun(part_of(progress, index / count, (index + 1) / count), seconds=seconds)
        given = Trajectory(
            t_us=trajectory.t_us + applied_us, T_world_camera=trajectory.T_world_camera
        )
        found = _found(events, given, camera, config, line_map, run)
        left = mean_offset([window.time_offset for window in found])
        if index + 1 == count or not left.exceeds(LEAST_OFFSET_US, OFFSET_SIGMA_COUNT):
            break
        applied_us += round(left.offset_us)
    report = replace(
        _report(found, left, trajectory, config, applied_us, seconds), intrinsics=intrinsics
    )
    for problem in report.problems:
        logger.warning("poses: %s", PROBLEMS[problem])
    poses, covariance = laid_over(
        trajectory.t_us,
        [window.window for window in found],
        [_at_given_times(window, trajectory, is_aligned=line_map is None) for window in found],
        [_covariance(window.last, window.given) for window in found],
    )
    refined = Trajectory(t_us=trajectory.t_us, T_world_camera=poses)
    return PoseResult(trajectory=refined, covariance=covariance, report=report)


def in_likeliest_world(refined: Trajectory, given: Trajectory, config: RefineConfig) -> Trajectory:
    """Refined poses where the given ones, by all they say, put the world.

    A path of a metre says little about how the world is turned, orientations say it directly:
    both count, each against the drift that is expected of it. Positions alone leave lines some
    metres away off by more.
    """
    drift = Drift.configured(config)
    poses, asked = refined.T_world_camera, given.T_world_camera
    T_world_refined = align_poses(poses, asked, lever_m=drift.sigma_m / drift.sigma_rad)
    return Trajectory(t_us=refined.t_us, T_world_camera=T_world_refined @ poses)


def _intrinsics(
    events: EventSource,
    trajectory: Trajectory,
    camera: Camera,
    config: Config,
    line_map: LineMap | None,
    seconds: dict[str, float],
    progress: ProgressCallback,
) -> IntrinsicsEstimate:
    """The calibration with which a recording is refined best."""
    tried = itertools.pairwise(itertools.count())

    def cost(other: Camera) -> float:
        # Nobody knows how many there will be.
        begin, end = (index / (index + USUAL_COST_COUNT) for index in next(tried))
        run = MappingRun(part_of(progress, begin, end), seconds=seconds)
        found = _found(events, trajectory, other, config, line_map, run)
        return sum(window.last.robust_cost for window in found)

    return intrinsics_search.estimate_intrinsics(camera, cost)


def _found(
    events: EventSource,
    given: Trajectory,
    camera: Camera,
    config: Config,
    line_map: LineMap | None,
    run: MappingRun,
) -> list[_Found]:
    """One run over the events: what each window of poses has come to."""
    counted = CountedEvents(events, given)
    smooth = smoothed(given)
    sharpness = camera.focal_px / RATE_FOCAL_PX
    rate_hz = min(config.frames.rate_hz, config.refine.pose_rate_hz / sharpness)
    config = replace(config, frames=replace(config.frames, rate_hz=rate_hz))
    detector = line_detector(config.detect)
    detected = lines_of_all_frames(counted, smooth, camera, config, detector, run)
    counted.check_coverage()
    return [
        _found_in(window, detected, given, smooth, config, line_map, run)
        for window in pose_windows(given, config.refine)
    ]


def _found_in(
    window: slice,
    detected: Detected,
    given: Trajectory,
    smooth: Trajectory,
    config: Config,
    line_map: LineMap | None,
    run: MappingRun,
) -> _Found:
    """The refined poses of one window."""
    given, smooth = _of_window(given, window), _of_window(smooth, window)
    detected = seen_between(detected, int(given.t_us[0]), int(given.t_us[-1]))
    correction = PoseCorrection.none(given, config.refine.pose_interval_us)
    if line_map is None:
        refined, rounds = _with_own_lines(detected, smooth, correction, config, run)
    else:
        refined, rounds = _in_map(line_map, detected, smooth, correction, config, run)
    return _Found(window=window, given=given, smooth=smooth, refined=refined, rounds=rounds)


def _of_window(trajectory: Trajectory, window: slice) -> Trajectory:
    return Trajectory(
        t_us=trajectory.t_us[window], T_world_camera=trajectory.T_world_camera[window]
    )


def _at_given_times(found: _Found, trajectory: Trajectory, *, is_aligned: bool) -> SE3:
    """The refined poses of a window, in the world of the given ones or of the map."""
    asked = _of_window(trajectory, found.window)
    poses = found.last.correction.trajectory(found.smooth).T_world_camera
    if is_aligned:
        # Steps of the solver drift along the scale, by more than the given poses are off.
        poses = as_large_as(poses, asked.T_world_camera)
        poses = align_poses(poses, asked.T_world_camera) @ poses
    if found.given.t_us[0] == asked.t_us[0]:
        return poses
    refined = Trajectory(t_us=found.given.t_us, T_world_camera=poses)
    # Poses that the other clock leaves without a time of their own stay at the ends.
    times_us = np.clip(asked.t_us, refined.t_us[0], refined.t_us[-1])
    return refined.interpolate(times_us)


def _report(
    found: list[_Found],
    left: TimeOffset,
    trajectory: Trajectory,
    config: Config,
    applied_us: int,
    seconds: dict[str, float],
) -> PoseReport:
    observation_count = sum(len(window.refined.tracks.observation) for window in found)
    px2 = config.refine.pose_noise_px**2 / max(1, observation_count)
    rounds = [joint for window in found for joint in window.rounds]
    return PoseReport(
        line_count=sum(len(window.refined) for window in found),
        observation_count=observation_count,
        iteration_count=sum(len(joint.costs) for joint in rounds),
        converged=all(window.last.converged for window in found),
        cost_initial=px2 * sum(window.rounds[0].costs[0] for window in found),
        cost_final=px2 * sum(window.last.cost for window in found),
        time_offset_us=applied_us + left.offset_us,
        time_offset_sigma_us=left.sigma_us,
        problems=_problems(found, left, trajectory, config),
        seconds=seconds,
    )


def _problems(
    found: list[_Found], left: TimeOffset, trajectory: Trajectory, config: Config
) -> tuple[PoseProblem, ...]:
    """What is wrong with the given poses beyond an odometry's jitter and drift."""
    expected = Drift.configured(config.refine)
    drifts = [window.last.drift_told for window in found]
    is_there = {
        PoseProblem.JUMPS: bool(pose_jumps(trajectory).any()),
        PoseProblem.TIME_OFFSET: left.exceeds(LEAST_OFFSET_US, OFFSET_SIGMA_COUNT),
        PoseProblem.FAR_OFF: _focal_length_is_off(found)
        or any(
            drift.sigma_rad > FAR_FACTOR * expected.sigma_rad
            or drift.sigma_m > FAR_FACTOR * expected.sigma_m
            for drift in drifts
        ),
    }
    return tuple(problem for problem, there in is_there.items() if there)


def _focal_length_is_off(found: list[_Found]) -> bool:
    """Whether the lines of any window say so; then by how much is told."""
    off = [
        error
        for error in (window.last.focal_error for window in found)
        if error.exceeds(LEAST_FOCAL_SHARE, OFFSET_SIGMA_COUNT)
    ]
    for error in off:
        logger.warning(
            "calibration: the focal length seems to be %+.1f %% off what is given",
            100.0 * error.share,
        )
    return bool(off)


def gates_px(config: RefineConfig, focal_px: float) -> list[float]:
    """Gates of the rounds: the last as it is, the first wide enough for what the poses are turned.

    Lines that are seen again at the end of a recording close its loop. A first gate in pixels alone
    leaves them out where pixels are small against what the given poses are turned.
    """
    given_px = np.array(config.pose_gates_px)
    turn_px = np.radians(config.pose_turn_deg) * focal_px
    above_last = np.log(given_px / given_px[-1])
    if above_last[0] > 0.0:
        widest = np.log(max(given_px[0], turn_px) / given_px[-1])
        above_last *= widest / above_last[0]
    return list(given_px[-1] * np.exp(above_last))


def closing_gates(gates: Sequence[float], found: Sequence[JointlyRefined]) -> Iterator[float]:
    """The gate of each round, px; `found` gets what a round has come to before the next one."""
    for gate_px in gates:
        for _ in range(MAX_ROUND_COUNT):
            yield gate_px
            if found[-1].moved_px <= SETTLED_SHARE * gate_px:
                break


def _first_lines(detected: Detected, config: Config, run: MappingRun) -> Refined:
    """Lines of neighbouring frames, triangulated as well as the poses allow."""
    frames, evidence = detected.frames, detected.evidence
    first_px = gates_px(config.refine, frames.focal_px)[0]
    local = config.match_local
    reach_px = max(local.max_distance_px, first_px + MATCH_MARGIN_PX)
    with run.stage("match_local"):
        tracks = match_adjacent_frames(
            detected.observations,
            frames,
            replace(local, max_distance_px=reach_px),
            rotation_is_undone=config.frames.compensate_rotation,
        )
    gate_px = max(config.triangulate.max_residual_px, first_px + TRACK_MARGIN_PX)
    with run.stage("triangulate"):
        found = triangulate_tracks(
            tracks,
            evidence.views,
            frames,
            replace(config.triangulate, max_residual_px=gate_px),
            np.random.default_rng(config.runtime.seed),
            worker_count=worker_count(config),
        )
        loose = _with_gate(config, first_px)
        return run.without_diverged(
            refine_lines(
                found.lines,
                found.tracks,
                evidence,
                frames,
                loose.refine,
                worker_count=worker_count(config),
            )
        )


def _with_own_lines(
    detected: Detected,
    smooth: Trajectory,
    correction: PoseCorrection,
    config: Config,
    run: MappingRun,
) -> tuple[Refined, list[JointlyRefined]]:
    """Rounds of matching with the poses as they are, and of refining lines and poses together."""
    workers = worker_count(config)
    refined = _first_lines(detected, config, run)
    drift = Drift.configured(config.refine)
    frames, evidence = _seen_with(detected, correction)
    found: list[JointlyRefined] = []
    for gate_px in closing_gates(gates_px(config.refine, detected.frames.focal_px), found):
        gated = _with_gate(config, gate_px)
        with run.stage("match_global"):
            poses = correction.trajectory(smooth)
            refined = reassociate(
                refined,
                evidence,
                detected.observations,
                frames,
                poses,
                gated,
                run.step,
            )
        check_line_count(refined)
        with run.stage("refine"):
            directions = direction_prior(refined, gated.refine, workers)
            joint = refine_jointly(
                refined,
                correction,
                drift,
                detected,
                gated.refine,
                directions,
                worker_count=workers,
            )
            correction, drift = joint.correction, joint.drift
            frames, evidence = _seen_with(detected, correction)
            refined = run.without_diverged(
                refine_lines(
                    joint.lines,
                    refined.tracks,
                    evidence,
                    frames,
                    gated.refine,
                    directions,
                    worker_count=workers,
                )
            )
        found.append(joint)
    return refined, found


def _in_map(
    line_map: LineMap,
    detected: Detected,
    smooth: Trajectory,
    correction: PoseCorrection,
    config: Config,
    run: MappingRun,
) -> tuple[Refined, list[JointlyRefined]]:
    """Rounds of matching with the poses as they are, and of refining them alone."""
    direction, moment = plucker.plucker_from_endpoints(line_map.segments)
    lines = InfiniteLines(direction=direction, moment=moment)
    given_px = config.refine.pose_gates_px
    drift = Drift.configured(config.refine)
    found: list[JointlyRefined] = []
    for gate_px in closing_gates([*(wider * given_px[0] for wider in MAP_GATES), *given_px], found):
        gated = _with_gate(config, gate_px)
        with run.stage("match_global"):
            frames, evidence = _seen_with(detected, correction)
            poses = correction.trajectory(smooth)
            refined = match_fixed_lines(
                lines, line_map.segments, evidence, detected.observations, frames, poses, gated
            )
        check_line_count(refined)
        with run.stage("refine"):
            joint = refine_jointly(
                refined,
                correction,
                drift,
                detected,
                gated.refine,
                None,
                free_lines=False,
                worker_count=worker_count(config),
            )
            correction, drift = joint.correction, joint.drift
        found.append(joint)
    return refined, found


def _with_gate(config: Config, gate_px: float) -> Config:
    """Matching and refinement within a distance, never closer than with known poses."""
    scale_px = max(config.refine.pose_loss_scale_px, FULL_WEIGHT_SHARE * gate_px)
    return replace(
        config,
        match_global=replace(config.match_global, max_distances_px=(gate_px,)),
        refine_rounds=_gated(config.refine_rounds, gate_px, scale_px),
        refine=_gated(config.refine, gate_px, scale_px),
    )


def _gated(costs: Costs, gate_px: float, scale_px: float) -> Costs:
    # Residuals are those of the poses: a loss that followed them would let wrong matches in.
    return replace(
        costs,
        max_residual_px=max(costs.max_residual_px, gate_px),
        loss_scale_px=scale_px,
        loss_scale_medians=0.0,
    )


def _seen_with(detected: Detected, correction: PoseCorrection) -> tuple[Frames, Evidence]:
    """Frames and evidence with corrected poses."""
    frames = detected.frames
    poses = correction.applied(frames.t_us, frames.T_world_camera)
    frames = replace(frames, T_world_camera=poses)
    return frames, replace(detected.evidence, views=views_of(detected.observations, frames))


def _covariance(joint: JointlyRefined, trajectory: Trajectory) -> FloatArray:
    """(N, 6, 6) of the poses at their own times, the lines being free.

    What observations of a line have in common is in no residual, and moves the poses all the same.
    """
    count = len(joint.correction)
    covariance = np.linalg.inv(joint.information).reshape(count, 6, count, 6)
    first, basis = joint.correction.basis(trajectory.t_us)
    shared = [FEIGNED_DRIFT.sigma_rad] * 3 + [FEIGNED_DRIFT.sigma_m] * 3
    found = np.tile(np.diag(np.square(shared)), (len(trajectory), 1, 1))
    for a, b in np.ndindex(basis.shape[1], basis.shape[1]):
        share = basis[:, a] * basis[:, b]
        found += share[:, None, None] * covariance[first + a, :, first + b, :]
    return found
