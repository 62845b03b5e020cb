"""Whether the clock of the poses runs beside that of the events.

Poses that are stamped too early or too late ask for a correction along the motion: c(t) = s v(t) with
the velocity v of the trajectory, on top of their drift. How large s is, and how surely, follows from
the refined correction and its normal equations; nothing is refined for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from roel_service.arrays import FloatArray, IntArray
from roel_service.geometry.se3 import vector_from_rotation
from roel_service.mapping.joint import JointlyRefined
from roel_service.mapping.pose_correction import PoseCorrection
from roel_service.scene.trajectory import Trajectory

# Velocities are measured over this time.
SPAN_US = 40_000


@dataclass(frozen=True, kw_only=True)
class TimeOffset:
    """What has to be added to the times of the poses.

    Attributes:
        offset_us: the estimate.
        sigma_us: its standard deviation; infinite where the camera does not move.
    """

    offset_us: float
    sigma_us: float

    def exceeds(self, least_us: float, sigma_count: float) -> bool:
        """Whether it is large, and surely so."""
        return abs(self.offset_us) > max(least_us, sigma_count * self.sigma_us)


def time_offset(joint: JointlyRefined, trajectory: Trajectory) -> TimeOffset:
    """The offset of a trajectory's clock, by what refinement found to be wrong with it.

    Args:
        joint: the correction, and its information.
        trajectory: that it is applied to.
    """
    velocity = velocities(trajectory, control_times_us(joint.correction)).ravel()
    prior = joint.drift.information(joint.correction)
    held = prior @ velocity
    # The correction's prior taken together with its observations: the marginal of s alone.
    known = linalg.solve(joint.information, held, assume_a="pos")
    information = float(velocity @ held - held @ known)
    if information <= 0.0:
        return TimeOffset(offset_us=0.0, sigma_us=float("inf"))
    s = float(held @ joint.correction.control.ravel()) / information
    return TimeOffset(offset_us=-1e6 * s, sigma_us=1e6 * information**-0.5)


def mean_offset(offsets: Sequence[TimeOffset]) -> TimeOffset:
    """Of the windows of one recording, each as sure as it is."""
    weights = np.array([offset.sigma_us for offset in offsets]) ** -2.0
    if not weights.any():
        return TimeOffset(offset_us=0.0, sigma_us=float("inf"))
    values = np.array([offset.offset_us for offset in offsets])
    return TimeOffset(
        offset_us=float(weights @ values / weights.sum()), sigma_us=float(weights.sum() ** -0.5)
    )


def control_times_us(correction: PoseCorrection) -> FloatArray:
    """(K,) times at which control points weigh most."""
    steps = np.arange(len(correction), dtype=np.float64) - 1.0
    return np.asarray(correction.first_us + steps * correction.interval_us)


def velocities(trajectory: Trajectory, t_us: FloatArray | IntArray) -> FloatArray:
    """(n, 6) turns in rad/s and speeds in m/s at (n,) times, world; those of the ends beyond them."""
    first_us, last_us = int(trajectory.t_us[0]), int(trajectory.t_us[-1])
    span_us = min(SPAN_US, last_us - first_us)
    middle_us = np.asarray(t_us).astype(np.int64)
    begin_us = np.clip(middle_us - span_us // 2, first_us, last_us - span_us)
    before, after = trajectory.interpolate(begin_us), trajectory.interpolate(begin_us + span_us)
    turn = vector_from_rotation(after.rotation @ np.swapaxes(before.rotation, -1, -2))
    step = np.concatenate([turn, after.translation - before.translation], axis=-1)
    return np.asarray(step / (span_us * 1e-6))
