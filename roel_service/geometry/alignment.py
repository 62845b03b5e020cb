"""Least-squares alignment of points and of poses that correspond."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.geometry.se3 import SE3

# Share of the positions' spread with which orientations count when poses are aligned: far below
# what positions tell, and far above rounding.
ORIENTATION_SHARE = 1e-6


@dataclass(frozen=True, eq=False, kw_only=True)
class Similarity:
    """p_target = scale * rotation(T_target_source) p_source + translation(T_target_source)."""

    scale: float
    T_target_source: SE3

    def apply(self, points: FloatArray) -> FloatArray:
        """(N, 3) points in the target frame."""
        moved = self.scale * self.T_target_source.rotate(points)
        return np.asarray(moved + self.T_target_source.translation)


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


def as_large_as(source: SE3, target: SE3) -> SE3:
    """The (N) poses of `source` on a path as large as that of `target`, about its own middle."""
    scale = align_points(source.translation, target.translation, with_scale=True).scale
    middle = source.translation.mean(axis=0)
    translation = middle + scale * (source.translation - middle)
    return SE3(rotation=source.rotation, translation=translation)


def align_poses(source: SE3, target: SE3, *, lever_m: float = 0.0) -> SE3:
    """T_target_source that brings corresponding poses together, by least squares.

    By their positions; where these leave a turn open, since the camera went straight or stood
    still, the orientations tell it. With a lever, orientations count throughout.

    Args:
        source, target: (N) poses, N >= 1.
        lever_m: how far off a position counts as much as an orientation that is off by 1 rad.
    """
    source_mean, target_mean = source.translation.mean(axis=0), target.translation.mean(axis=0)
    source_offsets = source.translation - source_mean
    turns = (target.rotation @ np.swapaxes(source.rotation, -1, -2)).mean(axis=0)
    spread = float((source_offsets**2).sum())
    weight = ORIENTATION_SHARE * spread if spread > 0.0 else 1.0
    # A squared turn is three less the trace of its matrix.
    weight += 0.5 * len(source_offsets) * lever_m**2
    covariance = (target.translation - target_mean).T @ source_offsets + weight * turns
    U, _, Vt = np.linalg.svd(covariance)
    rotation = (U * [1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return SE3(rotation=rotation, translation=target_mean - rotation @ source_mean)
