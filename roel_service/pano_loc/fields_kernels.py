"""Fields of distances: how far, in each of some directions, the nearest arc of each class is."""

from __future__ import annotations

import numba
import numpy as np

from roel_service.arrays import Array, FloatArray, IntArray

# Steps of a field in a radian; pi is 198.
STEPS_PER_RAD = 63.0
# What a class without arcs has everywhere.
EMPTY = 255


@numba.njit(cache=True, nogil=True)
def nearest_arcs(
    starts: FloatArray, ends: FloatArray, channel: IntArray, channel_count: int, rays: FloatArray
) -> Array:
    """(Q, K) uint8 angles, in steps, between (Q, 3) rays and the nearest arc of each class.

    Args:
        starts, ends: (A, 3) unit rays, not opposite each other.
        channel: (A,) class of each arc; -1 for none.
        channel_count: K.
        rays: (Q, 3) unit.
    """
    cosine = np.full((len(rays), channel_count), -2.0)
    for a in range(len(starts)):
        k = channel[a]
        if k < 0:
            continue
        sx, sy, sz = starts[a]
        ex, ey, ez = ends[a]
        nx, ny, nz = sy * ez - sz * ey, sz * ex - sx * ez, sx * ey - sy * ex
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        if length < 1e-9:
            continue
        nx, ny, nz = nx / length, ny / length, nz / length
        across = sx * ex + sy * ey + sz * ez
        for q in range(len(rays)):
            x, y, z = rays[q]
            to_start = x * sx + y * sy + z * sz
            to_end = x * ex + y * ey + z * ez
            if to_start > across * to_end and to_end > across * to_start:
                off = x * nx + y * ny + z * nz
                nearest = np.sqrt(max(0.0, 1.0 - off * off))
            else:
                nearest = max(to_start, to_end)
            if nearest > cosine[q, k]:
                cosine[q, k] = nearest
    field = np.empty((len(rays), channel_count), np.uint8)
    for q in range(len(rays)):
        for k in range(channel_count):
            if cosine[q, k] < -1.5:
                field[q, k] = EMPTY
            else:
                angle = np.arccos(min(1.0, max(-1.0, cosine[q, k])))
                field[q, k] = np.uint8(np.rint(angle * STEPS_PER_RAD))
    return field


@numba.njit(cache=True, nogil=True)
def map_fields(
    segments: FloatArray,
    channel: IntArray,
    channel_count: int,
    places: FloatArray,
    rays: FloatArray,
) -> Array:
    """(T, Q, K) uint8 fields of (L, 2, 3) segments as seen from (T, 3) places."""
    fields = np.empty((len(places), len(rays), channel_count), np.uint8)
    starts, ends = np.empty((len(segments), 3)), np.empty((len(segments), 3))
    for t in range(len(places)):
        for j in range(len(segments)):
            near, far = 0.0, 0.0
            for x in range(3):
                starts[j, x] = segments[j, 0, x] - places[t, x]
                ends[j, x] = segments[j, 1, x] - places[t, x]
                near += starts[j, x] ** 2
                far += ends[j, x] ** 2
            near, far = max(np.sqrt(near), 1e-9), max(np.sqrt(far), 1e-9)
            for x in range(3):
                starts[j, x] /= near
                ends[j, x] /= far
        fields[t] = nearest_arcs(starts, ends, channel, channel_count, rays)
    return fields


@numba.njit(cache=True, nogil=True)
def agreement(fields: Array, field: Array, weight: FloatArray, max_steps: int) -> FloatArray:
    """(T,) weighted share of rays and classes in which (T, Q, K) fields are close to one of them.

    A class that is empty on either side counts nothing.
    """
    count_t, count_q, count_k = fields.shape
    score = np.zeros(count_t)
    tally = np.empty(count_k, np.int64)
    for t in range(count_t):
        tally[:] = 0
        for q in range(count_q):
            for k in range(count_k):
                difference = np.int32(fields[t, q, k]) - np.int32(field[q, k])
                tally[k] += abs(difference) <= max_steps
        for k in range(count_k):
            if field[0, k] != EMPTY and fields[t, 0, k] != EMPTY:
                score[t] += weight[k] * tally[k] / count_q
    return score
