"""Timed camera poses and their interpolation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roel_service.arrays import BoolArray, IntArray, frozen_array
from roel_service.errors import TrajectoryError
from roel_service.geometry import se3
from roel_service.geometry.se3 import SE3

# A gap between poses longer than this is not bridged: the camera may have been anywhere.
MAX_POSE_GAP_US = 500_000


@dataclass(frozen=True, eq=False, kw_only=True)
class Trajectory:
    """Poses of one camera over time.

    Attributes:
        t_us: (N,) int64, strictly increasing.
        T_world_camera: (N) poses.

    Raises:
        TrajectoryError: fewer than two poses, or times that do not increase.
    """

    t_us: IntArray
    T_world_camera: SE3

    def __post_init__(self) -> None:
        t_us = frozen_array(self.t_us, np.int64, (None,), "t_us")
        object.__setattr__(self, "t_us", t_us)
        if len(t_us) < 2:
            raise TrajectoryError("poses", "at least 2 poses", f"{len(t_us)}")
        if self.T_world_camera.batch_shape != t_us.shape:
            found = f"{self.T_world_camera.batch_shape} poses"
            raise TrajectoryError("poses", f"one pose for each of {len(t_us)} times", found)
        stuck = np.diff(t_us) <= 0
        if stuck.any():
            index = int(np.argmax(stuck)) + 1
            raise TrajectoryError(
                "poses", "strictly increasing times", f"no increase at pose {index}"
            )

    def __len__(self) -> int:
        return len(self.t_us)

    def covered_us(self) -> IntArray:
        """(n, 2) first and last times between which no gap exceeds `MAX_POSE_GAP_US`, in order."""
        before_gap = np.flatnonzero(np.diff(self.t_us) > MAX_POSE_GAP_US)
        first = np.concatenate([[0], before_gap + 1])
        last = np.concatenate([before_gap, [len(self) - 1]])
        return np.stack([self.t_us[first], self.t_us[last]], axis=1)

    def covers(self, t_us: IntArray) -> BoolArray:
        """(K,) whether each time lies within the poses and in no gap above `MAX_POSE_GAP_US`."""
        first, last = self.covered_us().T
        index = np.searchsorted(first, t_us, side="right") - 1
        return np.asarray((index >= 0) & (np.asarray(t_us) <= last[index]))

    def interpolate(self, t_us: IntArray) -> SE3:
        """(K) poses at (K,) times: position linear, rotation on the shortest arc.

        Raises:
            TrajectoryError: a time outside the poses.
        """
        t_us = np.asarray(t_us)
        if t_us.size and (t_us.min() < self.t_us[0] or t_us.max() > self.t_us[-1]):
            raise TrajectoryError(
                "poses",
                f"times within {self.t_us[0]} and {self.t_us[-1]} us",
                f"{t_us.min()} to {t_us.max()} us",
                reason="POSE_COVERAGE_INSUFFICIENT",
            )
        right = np.clip(np.searchsorted(self.t_us, t_us), 1, len(self.t_us) - 1)
        left = right - 1
        fraction = (t_us - self.t_us[left]) / (self.t_us[right] - self.t_us[left])
        return se3.interpolate(self.T_world_camera[left], self.T_world_camera[right], fraction)
