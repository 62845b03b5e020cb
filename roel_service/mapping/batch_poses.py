"""Poses by the published batch: lines triangulated from the given poses, then everything at once.

Paper: "Pose Refinement". The lines are those of preset `paper`; a pose between two frames is
corrected as they are, in parts.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from roel_service.arrays import IntArray
from roel_service.config.stages import Config
from roel_service.errors import ConfigError
from roel_service.geometry.alignment import align_poses, as_large_as
from roel_service.geometry.se3 import SE3, vector_from_rotation
from roel_service.mapping.batch import RESIDUALS, BatchRefined, refine_batch
from roel_service.mapping.detect import line_detector
from roel_service.mapping.first_lines import check_line_count, matched_tracks, triangulated_lines
from roel_service.mapping.front_end import Detected, lines_of_all_frames
from roel_service.mapping.match_points import point_matcher
from roel_service.mapping.pose_jumps import pose_jumps
from roel_service.mapping.refine import Refined
from roel_service.mapping.run import CountedEvents, MappingRun
from roel_service.mapping.views import end_residuals_px, views_of
from roel_service.progress import ProgressCallback
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventSource
from roel_service.scene.lines import InfiniteLines
from roel_service.scene.results import PoseProblem, PoseReport, PoseResult
from roel_service.scene.trajectory import Trajectory


def refine_poses_at_once(
    events: EventSource,
    trajectory: Trajectory,
    camera: Camera,
    config: Config,
    progress: ProgressCallback,
) -> PoseResult:
    """Refine lines and one free pose a frame; arguments and errors as of `refine_poses`.

    Nothing is told of the clock, nor of a drift that is too large.

    Raises:
        ConfigError: a residual that the batch does not have.
    """
    if config.refine.residual not in RESIDUALS:
        expected = " or ".join(RESIDUALS) + " with refine.pose_method = batch"
        raise ConfigError("refine.residual", expected, config.refine.residual)
    run = MappingRun(progress)
    counted = CountedEvents(events, trajectory)
    detector = line_detector(config.detect)
    detected = lines_of_all_frames(counted, trajectory, camera, config, detector, run)
    counted.check_coverage()
    lines = _triangulated(detected, config, run)
    check_line_count(lines)
    with run.stage("refine"):
        found = refine_batch(lines, detected, config.refine)
    jumps = bool(pose_jumps(trajectory).any())
    return PoseResult(
        trajectory=Trajectory(
            t_us=trajectory.t_us, T_world_camera=_corrected(trajectory, detected, found)
        ),
        covariance=found.covariance[_nearest(trajectory.t_us, detected.frames.t_us)],
        report=PoseReport(
            line_count=len(lines),
            observation_count=len(lines.tracks.observation),
            iteration_count=len(found.costs) - 1,
            converged=found.converged,
            cost_initial=_mean_square_px2(
                lines, lines.lines, detected, detected.frames.T_world_camera
            ),
            cost_final=_mean_square_px2(lines, found.lines, detected, found.T_world_camera),
            time_offset_us=0.0,
            time_offset_sigma_us=float("inf"),
            problems=(PoseProblem.JUMPS,) if jumps else (),
            seconds=run.seconds,
        ),
    )


def _triangulated(detected: Detected, config: Config, run: MappingRun) -> Refined:
    """The lines as preset `paper` finds them with these poses."""
    matching = config.match_global
    points = point_matcher(matching) if matching.matches_points else None
    tracks = matched_tracks(detected, config, None, points, run)
    rng = np.random.default_rng(config.runtime.seed)
    with run.stage("triangulate"):
        return triangulated_lines(tracks, detected.evidence, detected.frames, config, rng, run)


def _corrected(trajectory: Trajectory, detected: Detected, found: BatchRefined) -> SE3:
    """The given poses with the frames' corrections in between, where the given ones are."""
    frames, given = detected.frames, trajectory.T_world_camera
    before, after = frames.T_world_camera, found.T_world_camera
    turn = vector_from_rotation(after.rotation @ np.swapaxes(before.rotation, -1, -2))
    tangent = np.concatenate([turn, after.translation - before.translation], axis=-1)
    between = [np.interp(trajectory.t_us, frames.t_us, column) for column in tangent.T]
    poses = as_large_as(given.retract(np.stack(between, axis=-1)), given)
    return align_poses(poses, given) @ poses


def _nearest(t_us: IntArray, frames_us: IntArray) -> IntArray:
    """(n,) index of the frame nearest in time."""
    return np.asarray(np.searchsorted((frames_us[1:] + frames_us[:-1]) / 2, t_us))


def _mean_square_px2(
    refined: Refined, lines: InfiniteLines, detected: Detected, poses: SE3
) -> float:
    """Mean square of the observations' larger end distances, with these lines and poses."""
    tracks = refined.tracks
    frames = replace(detected.frames, T_world_camera=poses)
    views = views_of(detected.observations, frames).take(tracks.observation)
    of_row = lines.take(tracks.track_of_row)
    ends_px = end_residuals_px(views, of_row.direction, of_row.moment, frames.focal_px)
    return float(np.mean(np.abs(ends_px).max(axis=-1) ** 2))
