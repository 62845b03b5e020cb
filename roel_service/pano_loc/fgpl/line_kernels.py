"""Merging of lines on the sphere."""

from __future__ import annotations

import numba
import numpy as np

from roel_service.arrays import Array, FloatArray

SWEEP_COUNT = 3
MIN_COSINE = np.cos(np.deg2rad(1.0))
TURN_RAD = 2.0 * np.pi


@numba.njit(cache=True, nogil=True)
def merge(ends: FloatArray, normals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Merged lines as (M, 3) starts and (M, 3) ends.

    A line is its normal and a range of longitudes about the axis that its normal is nearest to.

    Args:
        ends: (S, 2, 3) unit rays.
        normals: (S, 3) unit.
    """
    count = len(ends)
    normals = normals.copy()
    axis = np.empty(count, np.int64)
    low, reach, length = np.empty(count), np.empty(count), np.empty(count)
    for i in range(count):
        axis[i] = np.argmax(np.abs(normals[i]))
        first, second = _longitude(ends[i, 0], axis[i]), _longitude(ends[i, 1], axis[i])
        ahead = (second - first) % TURN_RAD
        # The shorter way round.
        low[i] = first if ahead <= np.pi else second
        reach[i] = min(ahead, TURN_RAD - ahead)
        length[i] = _angle(ends[i, 0], ends[i, 1])
    alive = np.ones(count, np.bool_)
    for _ in range(SWEEP_COUNT):
        for i in range(count):
            if alive[i]:
                _absorb(i, normals, axis, low, reach, length, alive)
    kept = np.flatnonzero(alive)
    starts, stops = np.empty((len(kept), 3)), np.empty((len(kept), 3))
    for at in range(len(kept)):
        line = kept[at]
        starts[at] = _ray(normals[line], axis[line], low[line])
        stops[at] = _ray(normals[line], axis[line], low[line] + reach[line])
    return starts, stops


@numba.njit(cache=True, nogil=True)
def _absorb(
    i: int,
    normals: FloatArray,
    axis: Array,
    low: FloatArray,
    reach: FloatArray,
    length: FloatArray,
    alive: Array,
) -> None:
    """Let line i take in all that are alike, judged by its normal before the first."""
    own = normals[i].copy()
    for j in range(len(normals)):
        if j == i or not alive[j] or abs(_dot(own, normals[j])) <= MIN_COSINE:
            continue
        ahead = (low[j] - low[i]) % TURN_RAD
        behind = (low[i] - low[j]) % TURN_RAD
        if ahead >= reach[i] and behind >= reach[j]:
            continue
        sign = 1.0 if normals[i, axis[i]] * normals[j, axis[i]] > 0 else -1.0
        merged = normals[i] * length[i] + sign * normals[j] * length[j]
        normals[i] = merged / np.sqrt(_dot(merged, merged))
        if ahead < reach[i]:
            reach[i] = max(reach[i], ahead + reach[j])
        else:
            low[i] = low[j]
            reach[i] = max(reach[j], behind + reach[i])
        first = _ray(normals[i], axis[i], low[i])
        length[i] = _angle(first, _ray(normals[i], axis[i], low[i] + reach[i]))
        alive[j] = False


@numba.njit(cache=True, nogil=True)
def _longitude(ray: FloatArray, axis: int) -> float:
    return float(np.arctan2(ray[(axis + 2) % 3], ray[(axis + 1) % 3]))


@numba.njit(cache=True, nogil=True)
def _ray(normal: FloatArray, axis: int, longitude_rad: float) -> FloatArray:
    """The ray of a longitude on the circle of a normal."""
    ray = np.empty(3)
    ray[(axis + 1) % 3], ray[(axis + 2) % 3] = np.cos(longitude_rad), np.sin(longitude_rad)
    across = (
        normal[(axis + 1) % 3] * ray[(axis + 1) % 3] + normal[(axis + 2) % 3] * ray[(axis + 2) % 3]
    )
    ray[axis] = -across / normal[axis]
    return np.asarray(ray / np.sqrt(_dot(ray, ray)))


@numba.njit(cache=True, nogil=True)
def _dot(a: FloatArray, b: FloatArray) -> float:
    """Of three numbers each, for which a call of BLAS takes too long."""
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


@numba.njit(cache=True, nogil=True)
def _angle(a: FloatArray, b: FloatArray) -> float:
    return float(np.arccos(min(1.0, max(-1.0, _dot(a, b)))))
