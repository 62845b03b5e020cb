"""Distances on the sphere, and how many of them agree."""

from __future__ import annotations

import numba
import numpy as np

from roel_service.arrays import Array, FloatArray, IntArray

CLASS_COUNT = 3
# Distances agree when they differ by less than this.
AGREEMENT = np.float32(0.1)


@numba.njit(cache=True, nogil=True)
def seen_from(segments: FloatArray, place: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(L, 3) unit rays to both ends of (L, 2, 3) segments."""
    starts, ends = np.empty((len(segments), 3)), np.empty((len(segments), 3))
    for line in range(len(segments)):
        a, b = segments[line, 0] - place, segments[line, 1] - place
        starts[line] = a / max(np.sqrt(np.dot(a, a)), 1e-9)
        ends[line] = b / max(np.sqrt(np.dot(b, b)), 1e-9)
    return starts, ends


@numba.njit(cache=True, nogil=True)
def line_distances(
    starts: FloatArray, ends: FloatArray, channel: IntArray, rays: FloatArray
) -> Array:
    """(Q, 3) float32 angles to the nearest arc of each class; pi for a class without any."""
    cosine = np.full((len(rays), CLASS_COUNT), -1.0)
    for line in range(len(starts)):
        k = channel[line]
        if k < 0:
            continue
        sx, sy, sz = starts[line]
        ex, ey, ez = ends[line]
        nx, ny, nz = sy * ez - sz * ey, sz * ex - sx * ez, sx * ey - sy * ex
        squared = max(nx * nx + ny * ny + nz * nz, 1e-18)
        across = sx * ex + sy * ey + sz * ez
        for q in range(len(rays)):
            x, y, z = rays[q]
            to_start = x * sx + y * sy + z * sz
            to_end = x * ex + y * ey + z * ez
            if to_start > across * to_end and to_end > across * to_start:
                off = x * nx + y * ny + z * nz
                nearest = np.sqrt(max(0.0, 1.0 - off * off / squared))
            else:
                nearest = max(to_start, to_end)
            if nearest > cosine[q, k]:
                cosine[q, k] = nearest
    return np.asarray(np.arccos(np.minimum(cosine, 1.0)).astype(np.float32))


@numba.njit(cache=True, nogil=True)
def point_distances(points: FloatArray, pair: IntArray, rays: FloatArray) -> Array:
    """(Q, 3) float32 angles to the nearest point of each pair; pi for a pair without any."""
    cosine = np.full((len(rays), CLASS_COUNT), -1.0)
    for point in range(len(points)):
        k = pair[point]
        px, py, pz = points[point]
        for q in range(len(rays)):
            nearest = px * rays[q, 0] + py * rays[q, 1] + pz * rays[q, 2]
            if nearest > cosine[q, k]:
                cosine[q, k] = nearest
    return np.asarray(np.arccos(np.minimum(cosine, 1.0)).astype(np.float32))


@numba.njit(cache=True, nogil=True)
def agreement(of_map: Array, of_picture: Array) -> IntArray:
    """(T, R) how many values of (T, M) and (R, M) functions agree."""
    count = np.empty((len(of_map), len(of_picture)), np.int64)
    for place in range(len(of_map)):
        for rotation in range(len(of_picture)):
            agreeing = 0
            for value in range(of_map.shape[1]):
                difference = of_map[place, value] - of_picture[rotation, value]
                agreeing += abs(difference) < AGREEMENT
            count[place, rotation] = agreeing
    return count


@numba.njit(cache=True, nogil=True)
def mutual_nearest(
    seen: FloatArray,
    seen_pair: IntArray,
    projected: FloatArray,
    pair: IntArray,
    min_cosine: float,
    same_pair: bool,
) -> IntArray:
    """(M, 2) indices of points that are nearest to each other on the sphere, and near.

    Args:
        seen, seen_pair: (N, 3) unit and (N,), the picture's.
        projected, pair: (P, 3) unit and (P,), the map's.
        min_cosine: of the angle between them.
        same_pair: points of different pairs are none.
    """
    best = np.full(len(seen), -2.0)
    at = np.full(len(seen), -1)
    best_back = np.full(len(projected), -2.0)
    back = np.full(len(projected), -1)
    for i in range(len(seen)):
        x, y, z = seen[i]
        for j in range(len(projected)):
            if same_pair and seen_pair[i] != pair[j]:
                continue
            cosine = x * projected[j, 0] + y * projected[j, 1] + z * projected[j, 2]
            if cosine > best[i]:
                best[i], at[i] = cosine, j
            if cosine > best_back[j]:
                best_back[j], back[j] = cosine, i
    matches = np.empty((len(seen), 2), np.int64)
    count = 0
    for i in range(len(seen)):
        if at[i] >= 0 and best[i] > min_cosine and back[at[i]] == i:
            matches[count] = i, at[i]
            count += 1
    return matches[:count]
