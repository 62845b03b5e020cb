"""Noisy poses made good by the lines that they see.

Paper: "Pose Refinement". The published batch optimisation moves the poses of triangulated lines
once; here matching and joint refinement take turns while the gates close, so that poses that are
too poor for the right matches get better ones.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.config.stages import Config
from roel_service.errors import NoAnswerError
from roel_service.geometry import plucker
from roel_service.geometry.alignment import align_poses
from roel_service.mapping.detect import line_detector
from roel_service.mapping.directions import direction_prior
from roel_service.mapping.evidence import Evidence
from roel_service.mapping.frames import Frames
from roel_service.mapping.front_end import Detected, lines_of_all_frames
from roel_service.mapping.joint import JointlyRefined, refine_jointly
from roel_service.mapping.match_global import match_fixed_lines, reassociate
from roel_service.mapping.match_local import match_adjacent_frames
from roel_service.mapping.pose_correction import Drift, PoseCorrection
from roel_service.mapping.refine import Refined, refine_lines
from roel_service.mapping.run import CountedEvents, MappingRun
from roel_service.mapping.smooth_poses import smoothed
from roel_service.mapping.triangulate import triangulate_tracks
from roel_service.mapping.views import views_of
from roel_service.progress import ProgressCallback, ignore
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventSource
from roel_service.scene.lines import InfiniteLines, LineMap
from roel_service.scene.results import PoseReport, PoseResult
from roel_service.scene.trajectory import Trajectory

# Fewer lines than this do not hold six unknowns.
MIN_LINE_COUNT = 6
# The first gates in a given map are so much wider than those of a recording's own lines: its world
# and that of the poses need not be quite the same.
MAP_GATES = (4.0, 2.0)
# While the gate is wide, residuals up to this share of it count in full.
FULL_WEIGHT_SHARE = 1.0 / 3.0
# Beyond the first gate: what noisy poses add between two frames, and over a whole track.
MATCH_MARGIN_PX = 0.5
TRACK_MARGIN_PX = 1.0


def refine_poses(
    events: EventSource,
    trajectory: Trajectory,
    camera: Camera,
    config: Config,
    *,
    line_map: LineMap | None = None,
    progress: ProgressCallback = ignore,
) -> PoseResult:
    """Refine the poses of a recording, together with the lines that it sees or in a given map.

    Without a map only the given poses tell where the world is: the result is aligned to them, and
    as large as they are.

    Args:
        events: read once, front to back.
        trajectory: poses on the clock of the events.
        camera: calibration of the sensor.
        config: parameters of every stage; those of the poses are in `refine`.
        line_map: lines that stay as they are; the given poses are roughly those in its world.
        progress: called often; may raise `Cancelled`.

    Raises:
        EventsError: no events.
        TrajectoryError: poses that cover less than a tenth of the recording.
        LimitError: RECORDING_TOO_LONG.
        NoAnswerError: too few lines.
        Cancelled: as raised by `progress`.
    """
    run = MappingRun(progress)
    counted = CountedEvents(events, trajectory)
    correction = PoseCorrection.none(trajectory, config.refine.pose_interval_us)
    smooth = smoothed(trajectory)
    detector = line_detector(config.detect)
    detected = lines_of_all_frames(counted, smooth, camera, config, detector, run)
    counted.check_coverage()
    if line_map is None:
        refined, found = _with_own_lines(detected, smooth, correction, config, run)
    else:
        refined, found = _in_map(line_map, detected, smooth, correction, config, run)
    observation_count = len(refined.tracks.observation)
    noise_px = config.refine.pose_noise_px
    poses = found[-1].correction.trajectory(smooth).T_world_camera
    if line_map is None:
        poses = align_poses(poses, trajectory.T_world_camera) @ poses
    return PoseResult(
        trajectory=Trajectory(t_us=trajectory.t_us, T_world_camera=poses),
        covariance=_covariance(found[-1], trajectory),
        report=PoseReport(
            line_count=len(refined),
            observation_count=observation_count,
            iteration_count=sum(len(joint.costs) - 1 for joint in found),
            converged=found[-1].converged,
            cost_initial=found[0].costs[0] * noise_px**2 / max(1, observation_count),
            cost_final=found[-1].costs[-1] * noise_px**2 / max(1, observation_count),
            seconds=run.seconds,
        ),
    )


def _first_lines(detected: Detected, config: Config, run: MappingRun) -> Refined:
    """Lines of neighbouring frames, triangulated as well as the poses allow."""
    first_px = config.refine.pose_gates_px[0]
    frames, evidence = detected.frames, detected.evidence
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
        )
        loose = _with_gate(config, first_px)
        return run.without_diverged(
            refine_lines(found.lines, found.tracks, evidence, frames, loose.refine)
        )


def _with_own_lines(
    detected: Detected,
    smooth: Trajectory,
    correction: PoseCorrection,
    config: Config,
    run: MappingRun,
) -> tuple[Refined, list[JointlyRefined]]:
    """Rounds of matching with the poses as they are, and of refining lines and poses together."""
    refined = _first_lines(detected, config, run)
    drift = Drift.configured(config.refine)
    found: list[JointlyRefined] = []
    for gate_px in config.refine.pose_gates_px:
        gated = _with_gate(config, gate_px)
        with run.stage("match_global"):
            frames, evidence = _seen_with(detected, correction)
            poses = correction.trajectory(smooth)
            refined = reassociate(
                refined, evidence, detected.observations, frames, poses, gated, run.step
            )
        _check_count(refined)
        with run.stage("refine"):
            directions = direction_prior(refined, gated.refine)
            joint = refine_jointly(refined, correction, drift, detected, gated.refine, directions)
            correction, drift = joint.correction, joint.drift
            frames, evidence = _seen_with(detected, correction)
            refined = run.without_diverged(
                refine_lines(
                    joint.lines, refined.tracks, evidence, frames, gated.refine, directions
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
    gates_px = config.refine.pose_gates_px
    drift = Drift.configured(config.refine)
    found: list[JointlyRefined] = []
    for gate_px in (*(wider * gates_px[0] for wider in MAP_GATES), *gates_px):
        gated = _with_gate(config, gate_px)
        with run.stage("match_global"):
            frames, evidence = _seen_with(detected, correction)
            poses = correction.trajectory(smooth)
            refined = match_fixed_lines(
                lines, line_map.segments, evidence, detected.observations, frames, poses, gated
            )
        _check_count(refined)
        with run.stage("refine"):
            joint = refine_jointly(
                refined, correction, drift, detected, gated.refine, None, free_lines=False
            )
            correction, drift = joint.correction, joint.drift
        found.append(joint)
    return refined, found


def _check_count(refined: Refined) -> None:
    if len(refined) < MIN_LINE_COUNT:
        expected = f"at least {MIN_LINE_COUNT} lines in view"
        raise NoAnswerError("poses", expected, f"{len(refined)}", reason="TOO_FEW_LINES")


def _with_gate(config: Config, gate_px: float) -> Config:
    """Matching and refinement within a distance, never closer than with known poses."""
    refine = config.refine
    return replace(
        config,
        match_global=replace(config.match_global, max_distances_px=(gate_px,)),
        refine=replace(
            refine,
            max_residual_px=max(refine.max_residual_px, gate_px),
            loss_scale_px=max(refine.loss_scale_px, FULL_WEIGHT_SHARE * gate_px),
        ),
    )


def _seen_with(detected: Detected, correction: PoseCorrection) -> tuple[Frames, Evidence]:
    """Frames and evidence with corrected poses."""
    frames = detected.frames
    poses = correction.applied(frames.t_us, frames.T_world_camera)
    frames = replace(frames, T_world_camera=poses)
    return frames, replace(detected.evidence, views=views_of(detected.observations, frames))


def _covariance(joint: JointlyRefined, trajectory: Trajectory) -> FloatArray:
    """(N, 6, 6) of the poses at their own times, the lines being free."""
    count = len(joint.correction)
    covariance = np.linalg.inv(joint.information).reshape(count, 6, count, 6)
    first, basis = joint.correction.basis(trajectory.t_us)
    found = np.zeros((len(trajectory), 6, 6))
    for a, b in np.ndindex(basis.shape[1], basis.shape[1]):
        share = basis[:, a] * basis[:, b]
        found += share[:, None, None] * covariance[first + a, :, first + b, :]
    return found
