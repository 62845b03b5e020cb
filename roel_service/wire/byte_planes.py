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
        shifted = values >> values.dtype.type(8 * plane) if plane else values
        np.copyto(part, shifted, casting="unsafe")


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
    total = 0
    for index, plane in enumerate(planes.reshape(byte_count, -1)):
        # The upper planes are often empty, which is told ten times faster than their sum. 32 bits
        # hold the sum of so many bytes, and are added up twice as fast as 64.
        if plane.max():
            total += int(plane.sum(dtype=np.uint32)) << 8 * index
    return total


def largest_of_planes(planes: Array, byte_count: int) -> int:
    """Largest of the integers behind byte planes, found from the highest byte down."""
    largest = 0
    # 1 for every integer with the bytes found so far, 0 for the others; None as long as all have them.
    candidates: Array | None = None
    for plane in reversed(planes.reshape(byte_count, -1)):
        kept = plane if candidates is None else plane * candidates
        top = int(kept.max())
        if top:
            # All others are 0 there, or were left out before.
            candidates = (kept == top).view(np.uint8)
        largest = largest << 8 | top
    return largest
