"""Loops over pairs of arcs."""

from __future__ import annotations

import numba
import numpy as np

from roel_service.arrays import FloatArray, IntArray


@numba.njit(cache=True, nogil=True, inline="always")
def _dot(a: FloatArray, b: FloatArray) -> float:
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


@numba.njit(cache=True, nogil=True)
def join(
    starts: FloatArray, ends: FloatArray, normals: FloatArray, distance_rad: float, gap_rad: float
) -> IntArray:
    """(A,) group of each arc: those on the circle of a longer one, without a longer gap.

    Arcs are taken longest first; each that has no group yet opens one and collects what has none
    either, has both ends near its circle, and is reached over gaps that are short enough.
    """
    count = len(starts)
    group = np.full(count, -1, np.int64)
    group_count = 0
    low, high = np.empty(count), np.empty(count)
    member = np.empty(count, np.int64)
    sine = np.sin(distance_rad)
    for i in range(count):
        if group[i] >= 0:
            continue
        normal = normals[i]
        ahead = starts[i] + ends[i]
        aside = np.array(
            [
                normal[1] * ahead[2] - normal[2] * ahead[1],
                normal[2] * ahead[0] - normal[0] * ahead[2],
                normal[0] * ahead[1] - normal[1] * ahead[0],
            ]
        )
        found = 0
        for j in range(i, count):
            if group[j] >= 0:
                continue
            if abs(_dot(normal, starts[j])) > sine or abs(_dot(normal, ends[j])) > sine:
                continue
            angle_1 = np.arctan2(_dot(starts[j], aside), _dot(starts[j], ahead))
            angle_2 = np.arctan2(_dot(ends[j], aside), _dot(ends[j], ahead))
            if abs(angle_1 - angle_2) > np.pi:  # across the far side of the circle
                continue
            low[found], high[found] = min(angle_1, angle_2), max(angle_1, angle_2)
            member[found] = j
            found += 1
        # The arc itself is the first; let its range grow until nothing is left within reach.
        first, last = low[0], high[0]
        group[i] = group_count
        grown = True
        while grown:
            grown = False
            for k in range(found):
                if group[member[k]] >= 0:
                    continue
                if low[k] <= last + gap_rad and high[k] >= first - gap_rad:
                    group[member[k]] = group_count
                    first, last = min(first, low[k]), max(last, high[k])
                    grown = True
        group_count += 1
    return group
