"""What a caller knows about a picture before it is located."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roel_service.arrays import FloatArray, frozen_array
from roel_service.geometry.se3 import SE3
from roel_service.geometry.vectors import norm

# Maps that may be asked for one picture.
MAX_MAP_COUNT = 8
DEFAULT_REACH_M, DEFAULT_REACH_RAD = 1.0, float(np.deg2rad(30.0))
DEFAULT_UP_SIGMA_RAD = float(np.deg2rad(3.0))
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
