"""Jitter taken out of a trajectory, as far as the trajectory itself tells it from motion.

Every coordinate becomes a cubic smoothing spline, as stiff as predicts the poses best that it has
not seen: poses that jump about are smoothed, poses without noise stay where they are.
"""

from __future__ import annotations

import numpy as np

from roel_service.arrays import FloatArray, IntArray
from roel_service.geometry.se3 import SE3
from roel_service.geometry.smoothing_spline import smoothing_spline
from roel_service.scene.trajectory import Trajectory

# Fewer poses than this, halved for the choice of stiffness, are no curve.
MIN_POSE_COUNT = 10
# Stiffness that is tried, with the poses' median interval as the unit of time: from hardly any to
# curves that change over some hundred poses.
STIFFNESS = np.logspace(-4, 8, 25)


def smoothed(trajectory: Trajectory) -> Trajectory:
    """The same times with smooth poses; nothing is smoothed across a gap of the poses."""
    poses = trajectory.T_world_camera
    rotation, translation = poses.rotation.copy(), poses.translation.copy()
    for first_us, last_us in trajectory.covered_us():
        piece = slice(*np.searchsorted(trajectory.t_us, [first_us, last_us + 1]))
        if piece.stop - piece.start < MIN_POSE_COUNT:
            continue
        smooth = _smooth_piece(trajectory.t_us[piece], poses[piece])
        rotation[piece], translation[piece] = smooth.rotation, smooth.translation
    smooth_poses = SE3(rotation=rotation, translation=translation)
    return Trajectory(t_us=trajectory.t_us, T_world_camera=smooth_poses)


def _smooth_piece(t_us: IntArray, poses: SE3) -> SE3:
    # In steps of the poses: the systems are badly scaled in microseconds.
    steps = (t_us - t_us[0]) / np.median(np.diff(t_us))
    quaternions = _smooth_curve(steps, _continuous(poses.quaternion_xyzw()))
    return SE3.from_quaternion(quaternions, _smooth_curve(steps, poses.translation))


def _smooth_curve(steps: FloatArray, values: FloatArray) -> FloatArray:
    """(N, D) values at (N,) times, smoothed with one stiffness."""
    errors = [_prediction_error(steps, values, stiffness) for stiffness in STIFFNESS]
    best = int(np.argmin(errors))
    # The least stiffness won: there is no noise to be seen.
    return values if best == 0 else _spline(steps, values, STIFFNESS[best], steps)


def _prediction_error(steps: FloatArray, values: FloatArray, stiffness: float) -> float:
    """Squared error of either half of the poses, every second one, foretold by the other half."""
    total = 0.0
    for half in (0, 1):
        # Ends are left out: there the other half would have to be extrapolated.
        hidden = slice(3 - half, -2, 2)
        foretold = _spline(steps[half::2], values[half::2], stiffness, steps[hidden])
        total += float(np.square(foretold - values[hidden]).sum())
    return total


def _spline(steps: FloatArray, values: FloatArray, stiffness: float, at: FloatArray) -> FloatArray:
    return np.asarray(smoothing_spline(steps, values, stiffness)(at))


def _continuous(quaternions: FloatArray) -> FloatArray:
    """(N, 4) the same rotations, each quaternion on the side of the one before it."""
    turns = np.sign(np.vecdot(quaternions[1:], quaternions[:-1]))
    sides = np.cumprod(np.concatenate([[1.0], np.where(turns == 0.0, 1.0, turns)]))
    return np.asarray(sides[:, None] * quaternions)
