"""Batched rigid transforms: `p_a = T_a_b @ p_b`.

Tangent order is (r, d): r in radians about the axes of frame a, d in metres along them, with
R <- Exp(r) R and t <- t + d. Solvers, covariances and information matrices share it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast, overload

import numpy as np
from scipy.spatial.transform import Rotation

from roel_service.arrays import FloatArray, frozen_array

# Below this angle (rad) sin(x)/x and its relatives switch to their series; the first dropped term
# is x^4/120, below float64 resolution there.
SMALL_ANGLE_RAD = 1e-4


@dataclass(frozen=True, eq=False, kw_only=True)
class SE3:
    """Rigid transforms with leading batch axes.

    Attributes:
        rotation: (*B, 3, 3) rotation matrices.
        translation: (*B, 3) m.
    """

    rotation: FloatArray
    translation: FloatArray

    def __post_init__(self) -> None:
        batch = np.shape(self.translation)[:-1]
        rotation = frozen_array(self.rotation, np.float64, (*batch, 3, 3), "rotation")
        translation = frozen_array(self.translation, np.float64, (*batch, 3), "translation")
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)

    @staticmethod
    def identity() -> SE3:
        return SE3(rotation=np.eye(3), translation=np.zeros(3))

    @staticmethod
    def from_matrix(matrix: FloatArray) -> SE3:
        """From (*B, 4, 4) homogeneous matrices; the last row is not looked at."""
        return SE3(rotation=matrix[..., :3, :3], translation=matrix[..., :3, 3])

    @staticmethod
    def from_quaternion(quaternion_xyzw: FloatArray, translation: FloatArray) -> SE3:
        """From (*B, 4) quaternions in x, y, z, w order (normalised here) and (*B, 3) m."""
        quaternion_xyzw = np.asarray(quaternion_xyzw, dtype=np.float64)
        flat = Rotation.from_quat(quaternion_xyzw.reshape(-1, 4)).as_matrix()
        rotation = flat.reshape(*quaternion_xyzw.shape[:-1], 3, 3)
        return SE3(rotation=rotation, translation=translation)

    @property
    def batch_shape(self) -> tuple[int, ...]:
        return self.translation.shape[:-1]

    def __len__(self) -> int:
        return int(self.translation.shape[0])

    def __getitem__(self, index: Any) -> SE3:
        """Index the batch axes, as NumPy does."""
        return SE3(rotation=self.rotation[index], translation=self.translation[index])

    @overload
    def __matmul__(self, other: SE3) -> SE3: ...
    @overload
    def __matmul__(self, other: FloatArray) -> FloatArray: ...
    def __matmul__(self, other: SE3 | FloatArray) -> SE3 | FloatArray:
        """Compose with a transform, or move (*B, 3) points."""
        if isinstance(other, SE3):
            return SE3(
                rotation=self.rotation @ other.rotation,
                translation=self.rotate(other.translation) + self.translation,
            )
        return self.rotate(other) + self.translation

    def rotate(self, vectors: FloatArray) -> FloatArray:
        """Turn (*B, 3) vectors without moving them."""
        return cast(FloatArray, np.einsum("...ij,...j->...i", self.rotation, vectors))

    def inverse(self) -> SE3:
        transposed = np.swapaxes(self.rotation, -1, -2)
        translation = -np.einsum("...ij,...j->...i", transposed, self.translation)
        return SE3(rotation=transposed, translation=translation)

    def retract(self, tangent: FloatArray) -> SE3:
        """Step by (*B, 6) tangents (r, d): R <- Exp(r) R, t <- t + d."""
        tangent = np.asarray(tangent)
        return SE3(
            rotation=rotation_from_vector(tangent[..., :3]) @ self.rotation,
            translation=self.translation + tangent[..., 3:],
        )

    def local(self, other: SE3) -> FloatArray:
        """(*B, 6) tangent with `self.retract(self.local(other)) == other`."""
        r = vector_from_rotation(other.rotation @ np.swapaxes(self.rotation, -1, -2))
        return np.concatenate([r, other.translation - self.translation], axis=-1)

    def matrix(self) -> FloatArray:
        """(*B, 4, 4) homogeneous matrices."""
        matrix = np.zeros((*self.batch_shape, 4, 4))
        matrix[..., :3, :3] = self.rotation
        matrix[..., :3, 3] = self.translation
        matrix[..., 3, 3] = 1.0
        return matrix

    def quaternion_xyzw(self) -> FloatArray:
        """(*B, 4) unit quaternions with w >= 0."""
        flat = Rotation.from_matrix(self.rotation.reshape(-1, 3, 3)).as_quat(canonical=True)
        return cast(FloatArray, flat.reshape(*self.batch_shape, 4))


def skew(vectors: FloatArray) -> FloatArray:
    """(*B, 3, 3) matrices [a]x with [a]x b = a x b."""
    matrix = np.zeros((*vectors.shape[:-1], 3, 3))
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    matrix[..., 0, 1], matrix[..., 0, 2] = -z, y
    matrix[..., 1, 0], matrix[..., 1, 2] = z, -x
    matrix[..., 2, 0], matrix[..., 2, 1] = -y, x
    return matrix


def rotation_from_vector(vectors: FloatArray) -> FloatArray:
    """(*B, 3, 3) rotations Exp(r) of (*B, 3) rotation vectors in radians (Rodrigues)."""
    vectors = np.asarray(vectors, dtype=np.float64)
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    small = angle < SMALL_ANGLE_RAD
    safe = np.where(small, 1.0, angle)
    sine = np.where(small, 1.0 - angle**2 / 6.0, np.sin(safe) / safe)
    cosine = np.where(small, 0.5 - angle**2 / 24.0, (1.0 - np.cos(safe)) / safe**2)
    cross = skew(vectors)
    return np.asarray(np.eye(3) + sine * cross + cosine * (cross @ cross), dtype=np.float64)


def rotation_vector_jacobian(vectors: FloatArray) -> FloatArray:
    """(*B, 3, 3) J of (*B, 3) rotation vectors r with Exp(r + dr) = Exp(J dr) Exp(r), for small dr.

    The left Jacobian of SO(3): J = I + (1 - cos a) / a^2 [r]x + (a - sin a) / a^3 [r]x^2, a = |r|.
    """
    vectors = np.asarray(vectors, dtype=np.float64)
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    small = angle < SMALL_ANGLE_RAD
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 0.5 - angle**2 / 24.0, (1.0 - np.cos(safe)) / safe**2)
    second = np.where(small, 1.0 / 6.0 - angle**2 / 120.0, (safe - np.sin(safe)) / safe**3)
    cross = skew(vectors)
    return np.asarray(np.eye(3) + first * cross + second * (cross @ cross), dtype=np.float64)


def vector_from_rotation(rotation: FloatArray) -> FloatArray:
    """(*B, 3) rotation vectors in radians of (*B, 3, 3) rotations, angle in [0, pi]."""
    flat = Rotation.from_matrix(np.asarray(rotation).reshape(-1, 3, 3)).as_rotvec()
    return cast(FloatArray, flat.reshape(*np.shape(rotation)[:-2], 3))


def rotation_angle(rotation: FloatArray) -> FloatArray:
    """(*B,) angles in radians of (*B, 3, 3) rotations.

    Uses 2 asin(|R - I|_F / 2 sqrt 2): the arccos of the trace returns 0 for angles near 1e-8.
    """
    deviation = np.linalg.norm(rotation - np.eye(3), axis=(-2, -1))
    return np.asarray(2.0 * np.arcsin(np.clip(deviation / (2.0 * np.sqrt(2.0)), 0.0, 1.0)))


def interpolate(a: SE3, b: SE3, fraction: FloatArray) -> SE3:
    """Transforms between `a` and `b`: translation linear, rotation on the shortest arc.

    Args:
        a, b: (*B) transforms at fractions 0 and 1.
        fraction: (*B) dimensionless.
    """
    relative = vector_from_rotation(np.swapaxes(a.rotation, -1, -2) @ b.rotation)
    share = np.asarray(fraction)[..., None]
    return SE3(
        rotation=a.rotation @ rotation_from_vector(share * relative),
        translation=a.translation + share * (b.translation - a.translation),
    )
