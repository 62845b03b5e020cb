"""Small vector algebra over leading batch axes, with NaN for what has no direction."""

from __future__ import annotations

import numpy as np

from roel_service.arrays import FloatArray

# Squares of shorter vectors underflow, and with them the digits of the length.
MIN_LENGTH = 1e-150


def dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """(*B,) inner products of (*B, D) vectors."""
    return np.asarray(np.vecdot(a, b), dtype=np.float64)


def norm(vectors: FloatArray) -> FloatArray:
    """(*B,) lengths of (*B, D) vectors."""
    return np.asarray(np.linalg.norm(vectors, axis=-1), dtype=np.float64)


def unit(vectors: FloatArray) -> FloatArray:
    """(*B, D) vectors of length one; NaN for a vector shorter than `MIN_LENGTH`."""
    length = norm(vectors)[..., None]
    return np.asarray(vectors / np.where(length > MIN_LENGTH, length, np.nan), dtype=np.float64)


def angle_between(a: FloatArray, b: FloatArray) -> FloatArray:
    """(*B,) angles in [0, pi] rad between (*B, 3) vectors of any length.

    The arctangent keeps full precision near 0 and pi, where the arccosine loses half the digits.
    """
    return np.asarray(np.arctan2(norm(np.cross(a, b)), dot(a, b)), dtype=np.float64)


def any_normal(directions: FloatArray) -> FloatArray:
    """(*B, 3) unit vectors normal to (*B, 3) nonzero directions; which of them is arbitrary."""
    # The axis least aligned with the direction makes the longest, hence safest, cross product.
    axis = np.eye(3)[np.argmin(np.abs(directions), axis=-1)]
    return unit(np.cross(directions, axis))
