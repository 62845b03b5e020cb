"""DBSCAN (Ester et al., 1996) on points in three dimensions.

A core point has at least `min_count` points, itself included, within the radius. Core points
within the radius of each other are of one cluster; another point is of the cluster of its nearest
core point within the radius, or of none.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from roel_service.arrays import Array


class Cells(NamedTuple):
    """Points by cubic cells with sides of the radius; the last axis is the fastest.

    Attributes:
        points: (n, 3).
        radius: in the unit of the points.
        key: (n,) int64 number of each point's cell.
        order: (n,) int64 points, cell by cell.
        ordered_key: (n,) int64 their cells, ascending.
        steps: (2,) int64 growth of the number by one cell along the first and the second axis.
    """

    points: Array
    radius: float
    key: Array
    order: Array
    ordered_key: Array
    steps: Array


@numba.njit(cache=True, nogil=True)
def dbscan(points: Array, radius: float, min_count: int) -> Array:
    """(n,) cluster of each point, numbered in the order of their first points; -1 for none.

    Memory is in proportion to the points, however dense they are.

    Args:
        points: (n, 3).
        radius: > 0, in the unit of the points; at least a millionth of their extent.
        min_count: points within the radius of a core point.
    """
    labels = np.full(len(points), -1, np.int64)
    if len(points) == 0:
        return labels
    cells = sort_into_cells(points, radius)
    near = np.empty(len(points), np.int64)
    core = np.zeros(len(points), np.bool_)
    for k in range(len(points)):
        core[k] = neighbours(k, cells, near) >= min_count
    root = np.arange(len(points))
    for k in range(len(points)):
        if core[k]:
            for i in near[: neighbours(k, cells, near)]:
                if core[i]:
                    join(root, k, i)
    label_of_root = np.full(len(points), -1, np.int64)
    count = 0
    for k in range(len(points)):
        member = k
        if not core[k]:
            member = nearest_core(k, cells, near[: neighbours(k, cells, near)], core)
            if member < 0:
                continue
        top = find(root, member)
        if label_of_root[top] < 0:
            label_of_root[top] = count
            count += 1
        labels[k] = label_of_root[top]
    return labels


@numba.njit(cache=True, nogil=True)
def sort_into_cells(points: Array, radius: float) -> Cells:
    """The cells of at least one point."""
    cell = np.empty(points.shape, np.int64)
    for axis in range(3):
        cell[:, axis] = np.floor((points[:, axis] - points[:, axis].min()) / radius)
    # Two empty cells after each row and column: neighbours of its ends are not in the next one.
    second = cell[:, 2].max() + 3
    first = second * (cell[:, 1].max() + 3)
    key = cell[:, 0] * first + cell[:, 1] * second + cell[:, 2]
    order = np.argsort(key, kind="mergesort")
    return Cells(points, radius, key, order, key[order], np.array([first, second]))


@numba.njit(cache=True, nogil=True)
def neighbours(k: int, cells: Cells, near: Array) -> int:
    """Write the points within the radius of point k, itself included, to `near`; their number."""
    count = 0
    for i in range(-1, 2):
        for j in range(-1, 2):
            middle = cells.key[k] + i * cells.steps[0] + j * cells.steps[1]
            start = np.searchsorted(cells.ordered_key, middle - 1)
            stop = np.searchsorted(cells.ordered_key, middle + 1, side="right")
            for other in cells.order[start:stop]:
                if squared_distance(cells.points, k, other) <= cells.radius * cells.radius:
                    near[count] = other
                    count += 1
    return count


@numba.njit(cache=True, nogil=True)
def squared_distance(points: Array, i: int, j: int) -> float:
    """Of two of the points."""
    x, y, z = (
        points[i, 0] - points[j, 0],
        points[i, 1] - points[j, 1],
        points[i, 2] - points[j, 2],
    )
    return float(x * x + y * y + z * z)


@numba.njit(cache=True, nogil=True)
def nearest_core(k: int, cells: Cells, near: Array, core: Array) -> int:
    """The core point among `near` that is nearest to point k, the first of equals; -1 for none."""
    best, best_distance = -1, np.inf
    for other in near:
        distance = squared_distance(cells.points, k, other)
        if core[other] and (
            distance < best_distance or (distance == best_distance and other < best)
        ):
            best, best_distance = other, distance
    return best


@numba.njit(cache=True, nogil=True)
def find(root: Array, k: int) -> int:
    """The representative of the set of k; paths are halved on the way."""
    while root[k] != k:
        root[k] = root[root[k]]
        k = root[k]
    return k


@numba.njit(cache=True, nogil=True)
def join(root: Array, i: int, j: int) -> None:
    """Make one set of those of i and j; the smaller representative stays."""
    i, j = find(root, i), find(root, j)
    root[max(i, j)] = min(i, j)
