"""Jumps of a trajectory: steps that neither the motion around them nor its jitter explains."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import median_filter

from roel_service.arrays import BoolArray, FloatArray
from roel_service.geometry.se3 import vector_from_rotation
from roel_service.geometry.vectors import norm
from roel_service.scene.trajectory import Trajectory

# A step is compared with the median of so many steps around it.
NEIGHBOUR_COUNT = 9
# A jump is so many times larger than the usual step, and than the usual change of steps.
JUMP_FACTOR = 10.0


def pose_jumps(trajectory: Trajectory) -> BoolArray:
    """(N - 1,) whether the poses jump between one and the next, in position or rotation.

    Nothing is said of gaps: their steps are as long as the motion made them.
    """
    poses = trajectory.T_world_camera
    span_s = np.diff(trajectory.t_us)[:, None] * 1e-6
    turns = vector_from_rotation(poses.rotation[1:] @ np.swapaxes(poses.rotation[:-1], -1, -2))
    steps = np.diff(poses.translation, axis=0)
    return _sudden(steps / span_s) | _sudden(turns / span_s)


def _sudden(rates: FloatArray) -> BoolArray:
    """(n,) rates (n, 3) that are far off those around them."""
    if len(rates) < NEIGHBOUR_COUNT:
        return np.zeros(len(rates), dtype=bool)
    usual = median_filter(rates, size=(NEIGHBOUR_COUNT, 1), mode="nearest")
    off = norm(rates - usual)
    most = JUMP_FACTOR * max(float(np.median(off)), float(np.median(norm(usual))))
    return np.asarray(off > most)
