"""Estimated poses against true ones: errors, absolute trajectory error, success."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.errors import TrajectoryError
from roel_service.geometry.alignment import align_points
from roel_service.geometry.se3 import SE3, rotation_angle
from roel_service.scene.trajectory import Trajectory


@dataclass(frozen=True, kw_only=True)
class TrajectoryErrors:
    """Errors of an aligned trajectory over the times at which the truth is known.

    Attributes:
        pose_count: poses compared.
        scale: of the alignment; 1 without one.
        ate_rmse_m, ate_mean_m, ate_median_m, ate_max_m: distances of the positions.
        rotation_rms_deg: of the angles between the orientations.
    """

    pose_count: int
    scale: float
    ate_rmse_m: float
    ate_mean_m: float
    ate_median_m: float
    ate_max_m: float
    rotation_rms_deg: float


def rotation_errors_rad(estimate: SE3, truth: SE3) -> FloatArray:
    """(*B,) angles between two orientations of each pose."""
    return rotation_angle(np.swapaxes(truth.rotation, -1, -2) @ estimate.rotation)


def translation_errors_m(estimate: SE3, truth: SE3) -> FloatArray:
    """(*B,) distances between two positions of each pose."""
    return np.asarray(np.linalg.norm(estimate.translation - truth.translation, axis=-1))


def success_rate(estimate: SE3, truth: SE3, max_distance_m: float, max_angle_deg: float) -> float:
    """Share of poses (*B) that are off by no more than both bounds; 0 for no pose."""
    near = translation_errors_m(estimate, truth) <= max_distance_m
    turned = np.degrees(rotation_errors_rad(estimate, truth)) <= max_angle_deg
    return float((near & turned).mean()) if near.size else 0.0


def trajectory_errors(
    estimate: Trajectory, truth: Trajectory, *, with_scale: bool = False
) -> TrajectoryErrors:
    """Absolute trajectory error after SE(3), or with scale Sim(3), alignment of the positions.

    The truth is interpolated at the times of the estimate; poses outside it do not count.

    Raises:
        TrajectoryError: the truth covers fewer than three poses.
    """
    covered = truth.covers(estimate.t_us)
    if covered.sum() < 3:
        raise TrajectoryError("poses", "at least 3 poses within the truth", f"{covered.sum()}")
    true_poses = truth.interpolate(estimate.t_us[covered])
    poses = estimate.T_world_camera[covered]
    alignment = align_points(poses.translation, true_poses.translation, with_scale=with_scale)
    aligned = SE3(
        rotation=alignment.T_target_source.rotation @ poses.rotation,
        translation=alignment.apply(poses.translation),
    )
    distances_m = translation_errors_m(aligned, true_poses)
    angles_deg = np.degrees(rotation_errors_rad(aligned, true_poses))
    return TrajectoryErrors(
        pose_count=len(distances_m),
        scale=alignment.scale,
        ate_rmse_m=float(np.sqrt(np.mean(distances_m**2))),
        ate_mean_m=float(distances_m.mean()),
        ate_median_m=float(np.median(distances_m)),
        ate_max_m=float(distances_m.max()),
        rotation_rms_deg=float(np.sqrt(np.mean(angles_deg**2))),
    )
