"""The vertical that both sides of a registration may know."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from roel_service.arrays import FloatArray, frozen_array
from roel_service.geometry.se3 import rotation_from_vector
from roel_service.geometry.vectors import norm

# A rotation that tilts the vertical by more is none.
MAX_TILT_RAD = np.radians(8.0)

Z = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False, kw_only=True)
class Vertical:
    """Which way is up on both sides.

    Attributes:
        up_source, up_target: (3,) unit.
    """

    up_source: FloatArray = field(default_factory=Z.copy)
    up_target: FloatArray = field(default_factory=Z.copy)

    def __post_init__(self) -> None:
        for name in ("up_source", "up_target"):
            up = frozen_array(getattr(self, name), np.float64, (3,), name)
            object.__setattr__(self, name, up / norm(up))

    def turned(self, angles_rad: FloatArray) -> FloatArray:
        """(R, 3, 3) the rotations of given headings, which lay up on up."""
        headings = rotation_from_vector(angles_rad[:, None] * Z)
        return np.asarray(_levelling(self.up_target).T @ headings @ _levelling(self.up_source))

    def headings_rad(self, rotations: FloatArray) -> FloatArray:
        """(H,) headings of those of (R, 3, 3) rotations that lay up on up, or nearly so."""
        level = _levelling(self.up_target) @ rotations @ _levelling(self.up_source).T
        upright = level[level[:, 2, 2] > np.cos(MAX_TILT_RAD)]
        sines, cosines = upright[:, 1, 0] - upright[:, 0, 1], upright[:, 0, 0] + upright[:, 1, 1]
        return np.asarray(np.arctan2(sines, cosines))


def _levelling(up: FloatArray) -> FloatArray:
    """(3, 3) the shortest rotation of a direction to z."""
    return np.asarray(Rotation.align_vectors(Z[None], up[None])[0].as_matrix())
