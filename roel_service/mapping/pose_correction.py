"""What is wrong with a trajectory, as a smooth function of time.

The correction is a uniform cubic B-spline of tangents (r, d) of `SE3.retract`, so that every event
can have a pose of its own time, and its prior is the drift of an odometry: an Ornstein-Uhlenbeck
process, which wanders off and forgets. The prior also holds what lines cannot tell: where the world
is, and how large.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

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
# Observations determine at least this share of the control points, when a drift is estimated.
MIN_KNOWN_SHARE = 1e-3
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


@dataclass(frozen=True, kw_only=True)
class Drift:
    """How far an odometry wanders off: an Ornstein-Uhlenbeck process of six coordinates.

    Attributes:
        sigma_rad, sigma_m: standard deviations of rotation and position.
        forgets_s: the time after which it has forgotten them.
    """

    sigma_rad: float
    sigma_m: float
    forgets_s: float

    @staticmethod
    def configured(config: RefineConfig) -> Drift:
        """What is expected of an odometry that nothing is known about."""
        return Drift(
            sigma_rad=float(np.deg2rad(config.pose_drift_deg)),
            sigma_m=config.pose_drift_m,
            forgets_s=config.pose_drift_s,
        )

    def information(self, correction: PoseCorrection) -> FloatArray:
        """(6 K, 6 K) inverse covariance of the control points, before anything is observed."""
        precisions = 1.0 / np.square([self.sigma_rad] * 3 + [self.sigma_m] * 3)
        information = np.kron(self._chain(correction), np.diag(precisions))
        return np.asarray(information, dtype=np.float64)

    def pull(self, correction: PoseCorrection) -> FloatArray:
        """(K, 6) the information times the control points."""
        precisions = 1.0 / np.square([self.sigma_rad] * 3 + [self.sigma_m] * 3)
        return np.asarray(self._chain(correction) @ correction.control * precisions)

    def estimated(self, correction: PoseCorrection, covariance: FloatArray) -> Drift:
        """The deviations under which a correction is as large as it was to be expected.

        One step towards the largest evidence (MacKay 1992): the squared correction, over as many
        unknowns as the observations determine. Poses that fit their observations as they are have
        no drift then, and stay.

        Args:
            correction: as refined with this drift.
            covariance: (6 K, 6 K) of its control points, given the observations.
        """
        count = len(correction)
        chain = self._chain(correction)
        blocks = covariance.reshape(count, 6, count, 6)
        sigmas = []
        for sigma, axes in ((self.sigma_rad, slice(0, 3)), (self.sigma_m, slice(3, 6))):
            control = correction.control[:, axes]
            size = np.einsum("ki,kl,li->", control, chain, control)
            open_count = np.einsum("kl,kili->", chain, blocks[:, axes, :, axes]) / sigma**2
            known_count = max(MIN_KNOWN_SHARE * control.size, control.size - open_count)
            sigmas.append(float(np.sqrt(size / known_count)))
        return replace(self, sigma_rad=sigmas[0], sigma_m=sigmas[1])

    def beyond(self, other: Drift) -> Drift:
        """What is left of it, where a part of its variance is another's."""
        return replace(
            self,
            sigma_rad=float(np.sqrt(max(self.sigma_rad**2 - other.sigma_rad**2, 0.0))),
            sigma_m=float(np.sqrt(max(self.sigma_m**2 - other.sigma_m**2, 0.0))),
        )

    def at_least(self, share: float, other: Drift) -> Drift:
        """With deviations of no less than a share of another drift's."""
        return replace(
            self,
            sigma_rad=max(self.sigma_rad, share * other.sigma_rad),
            sigma_m=max(self.sigma_m, share * other.sigma_m),
        )

    def _chain(self, correction: PoseCorrection) -> FloatArray:
        """(K, K) inverse covariance of a coordinate with deviation 1: tridiagonal."""
        keep = np.exp(-correction.interval_us * 1e-6 / self.forgets_s)
        count = len(correction)
        chain = (1.0 + keep**2) * np.eye(count)
        chain -= keep * (np.eye(count, k=1) + np.eye(count, k=-1))
        chain[0, 0] = chain[-1, -1] = 1.0
        return np.asarray(chain / (1.0 - keep**2))
