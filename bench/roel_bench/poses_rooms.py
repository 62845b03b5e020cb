"""Noisy poses of rooms: what refinement makes of them, and of exact ones, and the map that follows."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from roel_bench.scenes import MapTruth, Scene
from roel_service.arrays import FloatArray
from roel_service.config.presets import preset
from roel_service.config.stages import Config
from roel_service.errors import NoAnswerError
from roel_service.evaluation.maps import evaluate_map
from roel_service.evaluation.poses import trajectory_errors
from roel_service.geometry.alignment import align_poses
from roel_service.geometry.se3 import SE3, vector_from_rotation
from roel_service.mapping.pipeline import build_line_map
from roel_service.mapping.refine_poses import in_likeliest_world, refine_poses
from roel_service.mapping.smooth_poses import smoothed
from roel_service.progress import Progress
from roel_service.scene.lines import LineMap
from roel_service.scene.results import PoseResult
from roel_service.scene.trajectory import Trajectory

# Stages of a refinement in which lines are found in the events.
FRONT_END_STAGES = ("detect", "plane_fit")


@dataclass(frozen=True, kw_only=True)
class PoseErrors:
    """Of a trajectory after SE(3) alignment."""

    ate_mm: float
    rotation_deg: float


@dataclass(frozen=True, kw_only=True)
class RoomRow:
    """One room.

    Attributes:
        room, sensor, is_tuning: which.
        given, smooth, refined: errors of the noisy poses, of the same without jitter, and refined.
        exact: errors after refinement of the true poses.
        nees: mean normalised error squared of the refined poses over six; 1 is honest.
        time_offset_ms, problems: as reported of the noisy poses.
        iou_true, iou_refined, iou_aligned: IoU at 20 mm of the maps with true poses, with refined
            ones, and of the latter moved into the world of the truth.
        seconds: processor time of refinement.
        front_end_s: of it, what finding the lines in the events took; None of rows that do not tell.
    """

    room: str
    sensor: str
    is_tuning: bool
    given: PoseErrors
    smooth: PoseErrors
    refined: PoseErrors
    exact: PoseErrors
    nees: float
    time_offset_ms: float
    problems: tuple[str, ...]
    iou_true: float
    iou_refined: float
    iou_aligned: float
    seconds: float
    front_end_s: float | None = None


class _FrontEndClock:
    """Processor time until the lines of all frames are found; listens to a refinement's progress."""

    def __init__(self) -> None:
        self._began = time.process_time()
        self.seconds = 0.0

    def __call__(self, progress: Progress) -> None:
        if progress.stage in FRONT_END_STAGES:
            self.seconds = time.process_time() - self._began


def room_row(scene: Scene) -> RoomRow:
    """Refine the noisy and the true poses of a room, and build maps with what comes out."""
    given, truth = scene.noisy_trajectory, scene.trajectory
    if given is None or truth is None or not isinstance(scene.truth, MapTruth):
        raise NoAnswerError(scene.name, "true and noisy poses, and true surfaces", "none")
    config = preset("default")
    began = time.process_time()
    clock = _FrontEndClock()
    result = refine_poses(scene.events, given, scene.camera, config, progress=clock)
    seconds = time.process_time() - began
    exact = refine_poses(scene.events, truth, scene.camera, config)
    # As `map build --refine-poses` has it.
    placed = in_likeliest_world(result.trajectory, given, config.refine)
    refined_map = _map(scene, placed, config)
    return RoomRow(
        room=scene.name,
        sensor=scene.sensor,
        is_tuning=scene.is_tuning,
        given=_errors(given, truth),
        smooth=_errors(smoothed(given), truth),
        refined=_errors(result.trajectory, truth),
        exact=_errors(exact.trajectory, truth),
        nees=float(normalised_errors(result, given, truth).mean()),
        time_offset_ms=1e-3 * result.report.time_offset_us,
        problems=tuple(problem.value for problem in result.report.problems),
        iou_true=_iou(_map(scene, truth, config), scene.truth),
        iou_refined=_iou(refined_map, scene.truth),
        iou_aligned=_iou(_in_true_world(refined_map, placed, truth), scene.truth),
        seconds=seconds,
        front_end_s=clock.seconds,
    )


def _errors(estimate: Trajectory, truth: Trajectory) -> PoseErrors:
    errors = trajectory_errors(estimate, truth)
    return PoseErrors(ate_mm=1e3 * errors.ate_rmse_m, rotation_deg=errors.rotation_rms_deg)


def normalised_errors(result: PoseResult, given: Trajectory, truth: Trajectory) -> FloatArray:
    """(N,) errors squared in units of the covariance, over their six dimensions.

    The world of refined poses is that of the given ones: the truth is moved there first.
    """
    covered = truth.covers(given.t_us)
    found = result.trajectory.T_world_camera[covered]
    true = truth.interpolate(given.t_us[covered])
    true = align_poses(true, given.T_world_camera[covered]) @ true
    turn = vector_from_rotation(true.rotation @ np.swapaxes(found.rotation, -1, -2))
    error = np.concatenate([turn, true.translation - found.translation], axis=-1)
    weighted = np.linalg.solve(result.covariance[covered], error[..., None])[..., 0]
    return np.asarray(np.sum(error * weighted, axis=-1) / 6.0)


def _map(scene: Scene, trajectory: Trajectory, config: Config) -> LineMap:
    return build_line_map(scene.events, trajectory, scene.camera, config).line_map


def _in_true_world(line_map: LineMap, estimate: Trajectory, truth: Trajectory) -> LineMap:
    """The map, moved as the poses have to be to lie on the true ones."""
    covered = truth.covers(estimate.t_us)
    poses: SE3 = estimate.T_world_camera[covered]
    T_true_map = align_poses(poses, truth.interpolate(estimate.t_us[covered]))
    return replace(line_map, segments=T_true_map @ line_map.segments)


def _iou(line_map: LineMap, truth: MapTruth) -> float:
    if truth.edges is None:
        raise NoAnswerError("room", "true edges", "none")
    return evaluate_map(line_map, truth.mesh, truth.edges).iou_20
