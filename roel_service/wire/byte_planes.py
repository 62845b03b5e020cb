"""Integers as byte planes: all lowest bytes, then all second bytes, and so on.

Neighbouring values share their upper bytes, so planes compress far better than rows.
"""

from __future__ import annotations

import numpy as np

from roel_service.arrays import Array


def planes_from_integers(values: Array, byte_count: int) -> bytes:
    """The lowest `byte_count` bytes of (K,) non-negative integers."""
    planes: Array = np.empty(byte_count * len(values), np.uint8)
    write_planes(values, byte_count, planes)
    return planes.tobytes()


def write_planes(values: Array, byte_count: int, planes: Array) -> None:
    """Write the lowest bytes of (K,) non-negative integers to (byte_count * K,) uint8."""
    # Shift and cast, here and below: several times faster than transposing bytes.
    for plane, part in enumerate(planes.reshape(byte_count, -1)):
        part[:] = values >> values.dtype.type(8 * plane) if plane else values.astype(np.uint8)


def integers_from_planes(planes: Array, byte_count: int) -> Array:
    """(K,) unsigned integers of `byte_count` bytes (1, 2, 4, 8) from K times as many uint8."""
    count = len(planes) // byte_count
    dtype = np.dtype(f"u{byte_count}")
    values: Array = np.zeros(count, dtype)
    for plane in range(byte_count):
        part: Array = planes[plane * count : (plane + 1) * count].astype(dtype)
        values |= part << dtype.type(8 * plane)
    return values


def sum_of_planes(planes: Array, byte_count: int) -> int:
    """Sum of the integers behind byte planes; fewer than 2^24 of them."""
    # 32 bits hold the sum of so many bytes, and are added up twice as fast as 64.
    sums = planes.reshape(byte_count, -1).sum(axis=1, dtype=np.uint32)
    return sum(int(value) << 8 * plane for plane, value in enumerate(sums))


def largest_of_planes(planes: Array, byte_count: int) -> int:
    """Largest of the integers behind byte planes, found from the highest byte down."""
    *lower, highest = planes.reshape(byte_count, -1)
    largest = int(highest.max())
    candidates = highest == largest
    for plane in reversed(lower):
        kept = plane * candidates
        top = int(kept.max())
        candidates &= kept == top
        largest = largest << 8 | top
    return largest
