"""What is wrong with a trajectory, as a smooth function of time.

The correction is a uniform cubic B-spline of tangents (r, d) of `SE3.retract`, so that every event
can have a pose of its own time, and its prior is the drift of an odometry: an Ornstein-Uhlenbeck
process, which wanders off and forgets. The prior also holds what lines cannot tell: where the world
is, and how large.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from roel_service.arrays import FloatArray, IntArray, frozen_array
from roel_service.config.stages import RefineConfig
from roel_service.errors import LimitError
from roel_service.geometry.se3 import SE3
from roel_service.scene.trajectory import Trajectory

# A cubic B-spline depends on so many control points at any time.
ORDER = 4
# Control points that are solved for at once: their normal equations take 288 MiB.
MAX_CONTROL_COUNT = 1024
# (N, 4) shares of the control points at the time s in [0, 1] of their interval: powers of s.
BASIS = np.array([[1, -3, 3, -1], [4, 0, -6, 3], [1, 3, 3, -3], [0, 0, 0, 1]]) / 6.0


@dataclass(frozen=True, eq=False, kw_only=True)
class PoseCorrection:
    """A cubic B-spline of tangents over time.

    Attributes:
        first_us: where the first interval begins.
        interval_us: between control points.
        control: (K, 6) tangents (r, d), rad and m.
    """

    first_us: int
    interval_us: float
    control: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(
            self, "control", frozen_array(self.control, np.float64, (None, 6), "control")
        )

    @staticmethod
    def none(trajectory: Trajectory, interval_us: int) -> PoseCorrection:
        """No correction of a trajectory; control points at most so far apart.

        Raises:
            LimitError: RECORDING_TOO_LONG, more than `MAX_CONTROL_COUNT` control points.
        """
        first_us, last_us = int(trajectory.t_us[0]), int(trajectory.t_us[-1])
        interval_count = -(-(last_us - first_us) // interval_us)
        if interval_count + ORDER - 1 > MAX_CONTROL_COUNT:
            most_s = (MAX_CONTROL_COUNT - ORDER + 1) * interval_us * 1e-6
            expected = f"at most {most_s:.0f} s at refine.pose_interval_us = {interval_us}"
            found = f"{(last_us - first_us) * 1e-6:.0f} s"
            raise LimitError("poses to refine", expected, found, reason="RECORDING_TOO_LONG")
        return PoseCorrection(
            first_us=first_us,
            interval_us=(last_us - first_us) / interval_count,
            control=np.zeros((interval_count + ORDER - 1, 6)),
        )

    def __len__(self) -> int:
        return len(self.control)

    def basis(self, t_us: IntArray) -> tuple[IntArray, FloatArray]:
        """(N,) first of the control points that a time depends on, and (N, 4) their shares."""
        position = (np.asarray(t_us) - self.first_us) / self.interval_us
        first = np.clip(np.floor(position).astype(np.int64), 0, len(self) - ORDER)
        powers = (position - first)[:, None] ** np.arange(ORDER)
        return first, powers @ BASIS.T

    def shares(self, t_us: IntArray) -> sparse.csr_array:
        """(N, K) share of every control point at (N,) times, all but four of a row zero."""
        first, basis = self.basis(t_us)
        columns = first[:, None] + np.arange(ORDER)
        ends = np.arange(len(first) + 1) * ORDER
        return sparse.csr_array((basis.ravel(), columns.ravel(), ends), (len(first), len(self)))

    def stepped(self, step: FloatArray) -> PoseCorrection:
        """With other control points: these plus (K, 6)."""
        return PoseCorrection(
            first_us=self.first_us, interval_us=self.interval_us, control=self.control + step
        )

    def applied(self, t_us: IntArray, poses: SE3) -> SE3:
        """(N) poses at (N,) times, corrected."""
        return poses.retract(self.shares(t_us) @ self.control)

    def trajectory(self, trajectory: Trajectory) -> Trajectory:
        """A trajectory, corrected at its own times."""
        poses = self.applied(trajectory.t_us, trajectory.T_world_camera)
        return Trajectory(t_us=trajectory.t_us, T_world_camera=poses)


def drift_information(correction: PoseCorrection, config: RefineConfig) -> FloatArray:
    """(6 K, 6 K) inverse covariance of the control points, before anything is observed.

    Of an Ornstein-Uhlenbeck process with the configured deviation and time: its inverse covariance
    at equal steps is tridiagonal.
    """
    keep = np.exp(-correction.interval_us * 1e-6 / config.pose_drift_s)
    count = len(correction)
    chain = (1.0 + keep**2) * np.eye(count) - keep * (np.eye(count, k=1) + np.eye(count, k=-1))
    chain[0, 0] = chain[-1, -1] = 1.0
    deviation = [np.deg2rad(config.pose_drift_deg)] * 3 + [config.pose_drift_m] * 3
    return np.kron(chain / (1.0 - keep**2), np.diag(1.0 / np.square(deviation)))
