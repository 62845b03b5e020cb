"""Estimated poses against true ones: errors, alignment, absolute trajectory error, success."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.errors import TrajectoryError
from roel_service.geometry.se3 import SE3, rotation_angle
from roel_service.scene.trajectory import Trajectory


@dataclass(frozen=True, eq=False, kw_only=True)
class Similarity:
    """p_target = scale * rotation(T_target_source) p_source + translation(T_target_source)."""

    scale: float
    T_target_source: SE3

    def apply(self, points: FloatArray) -> FloatArray:
        """(N, 3) points in the target frame."""
        moved = self.scale * self.T_target_source.rotate(points)
        return np.asarray(moved + self.T_target_source.translation)


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


def align_points(source: FloatArray, target: FloatArray, *, with_scale: bool) -> Similarity:
    """Least-squares alignment of corresponding points (Umeyama 1991).

    Where the points lie on one line, any turn about it is as good; one of them is returned.

    Args:
        source, target: (N, 3) m, N >= 1.
        with_scale: whether the scale is free; it stays 1 where the source is one point.
    """
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    source_offsets, target_offsets = source - source_mean, target - target_mean
    U, singular, Vt = np.linalg.svd(target_offsets.T @ source_offsets)
    # The nearest orthogonal matrix may be a reflection; then the weakest axis is turned over.
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    rotation = (U * signs) @ Vt
    spread = float((source_offsets**2).sum())
    scale = float((singular * signs).sum()) / spread if with_scale and spread > 0.0 else 1.0
    translation = target_mean - scale * rotation @ source_mean
    return Similarity(scale=scale, T_target_source=SE3(rotation=rotation, translation=translation))


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
