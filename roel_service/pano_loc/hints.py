"""What a caller knows about a picture before it is located."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roel_service.arrays import BoolArray, FloatArray, frozen_array
from roel_service.geometry.se3 import SE3, rotation_angle
from roel_service.geometry.vectors import norm

# Maps that may be asked for one picture.
MAX_MAP_COUNT = 8
DEFAULT_REACH_M, DEFAULT_REACH_RAD = 1.0, float(np.deg2rad(30.0))
DEFAULT_UP_SIGMA_RAD = float(np.deg2rad(3.0))
# What is found from within reach may lie so far beyond it.
REACH_SLACK_M, REACH_SLACK_RAD = 0.1, float(np.deg2rad(2.0))
# Orientations stay within so many deviations of gravity, and never closer than this.
UP_REACH_SIGMAS, MIN_UP_REACH_RAD = 3.0, float(np.deg2rad(5.0))


@dataclass(frozen=True, eq=False, kw_only=True)
class PosePrior:
    """About where a picture was taken; the search stays within reach of it.

    Attributes:
        T_world_picture: first pose, in the world of every map that is asked.
        reach_m, reach_rad: how far it is trusted.
    """

    T_world_picture: SE3
    reach_m: float = DEFAULT_REACH_M
    reach_rad: float = DEFAULT_REACH_RAD

    def holds(self, poses: SE3) -> BoolArray:
        """(C,) which of C poses are within reach, or hardly beyond it."""
        shift_m = norm(poses.translation - self.T_world_picture.translation)
        turn_rad = rotation_angle(poses.rotation @ self.T_world_picture.rotation.T)
        return np.asarray(
            (shift_m <= self.reach_m + REACH_SLACK_M)
            & (turn_rad <= self.reach_rad + REACH_SLACK_RAD)
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Gravity:
    """Which way is up, in the map and in the picture.

    Attributes:
        up_world, up_picture: (3,) unit.
        sigma_rad: standard deviation of the angle between them at the true pose.
    """

    up_world: FloatArray
    up_picture: FloatArray
    sigma_rad: float = DEFAULT_UP_SIGMA_RAD

    def __post_init__(self) -> None:
        for name in ("up_world", "up_picture"):
            up = frozen_array(getattr(self, name), np.float64, (3,), name)
            object.__setattr__(self, name, up / norm(up))

    def agrees(self, rotations: FloatArray) -> FloatArray:
        """(R,) which of (R, 3, 3) R_world_picture keep up where it is."""
        cosine = rotations @ self.up_picture @ self.up_world
        reach_rad = max(UP_REACH_SIGMAS * self.sigma_rad, MIN_UP_REACH_RAD)
        return np.asarray(cosine >= np.cos(reach_rad))
