"""Three principal directions of a picture and of a map, by voting on the sphere."""

from __future__ import annotations

from functools import lru_cache
from itertools import combinations

import numpy as np

from roel_service.arrays import Array, FloatArray, IntArray
from roel_service.geometry.vectors import unit

VOTE_LEVEL, QUERY_LEVEL = 5, 3
# An arc votes for the directions whose product with its normal is below this.
VOTE_SINE = 0.05
CANDIDATE_COUNT = 20
# Directions of a triple, or of a pair, are that close to right angles.
TRIPLE_COSINE, PAIR_COSINE = 0.1, 0.15
# Lines this close to a direction have voted for it.
VOTED_COSINE = 0.95
# Lines belong to a class: an arc for its intersections, an arc for its distance function, a map's
# line for its intersections, a map's line for its distance function.
POINT_ARC_SINE, FIELD_ARC_SINE = 0.5, 0.05
POINT_LINE_COSINE, FIELD_LINE_COSINE = 0.9, 0.95


@lru_cache(maxsize=2)
def sphere_points(level: int) -> FloatArray:
    """(10 4^level + 2, 3) unit: an icosahedron, its faces cut in four so many times."""
    import trimesh

    return np.asarray(unit(trimesh.creation.icosphere(subdivisions=level).vertices))


@lru_cache(maxsize=1)
def vote_points() -> FloatArray:
    """(5121, 3) unit, one of each two opposite ones."""
    points = sphere_points(VOTE_LEVEL)
    x, y, z = np.round(points, 9).T
    return np.asarray(points[(z > 0) | ((z == 0) & ((y > 0) | ((y == 0) & (x > 0))))])


def directions_of_arcs(normals: FloatArray) -> FloatArray:
    """(3, 3) unit rows, of determinant +1 where they are at right angles.

    Args:
        normals: (A, 3) unit, of the arcs that vote.
    """
    points = vote_points()
    votes_for = (np.abs(normals @ points.T) < VOTE_SINE).astype(np.float32)
    voters = np.ones(len(normals), np.float32)
    found: list[FloatArray] = []
    while voters.any() and len(found) < CANDIDATE_COUNT:
        best = int((voters @ votes_for).argmax())
        found.append(points[best])
        voters *= 1 - votes_for[:, best]
    return _proper(_triple(np.array(found).reshape(-1, 3)))


def _triple(found: FloatArray) -> FloatArray:
    """(3, 3) the first directions at about right angles, strongest first."""
    cosine = np.abs(found @ found.T)
    for i, j, k in combinations(range(len(found)), 3):
        if max(cosine[i, j], cosine[j, k], cosine[i, k]) < TRIPLE_COSINE:
            return np.asarray(found[[i, j, k]])
    for i, j in combinations(range(len(found)), 2):
        if cosine[i, j] < PAIR_COSINE:
            return _completed(found[i], found[j])
    if len(found) >= 2:
        return _completed(found[0], found[1])
    return np.eye(3)


def _completed(first: FloatArray, second: FloatArray) -> FloatArray:
    return np.stack([first, second, unit(np.cross(first, second))])


def _proper(rows: FloatArray) -> FloatArray:
    """The same with the last one turned round if need be."""
    return rows * [[1.0], [1.0], [1.0 if np.linalg.det(rows) >= 0 else -1.0]]


def directions_of_lines(directions: FloatArray) -> FloatArray:
    """(3, 3) unit rows, which need not be at right angles.

    Args:
        directions: (L, 3) unit, of the lines that vote.
    """
    points = vote_points()
    found: list[FloatArray] = []
    for _ in range(3):
        nearest = np.abs(directions @ points.T).argmax(axis=1)
        best = int(np.bincount(nearest, minlength=len(points)).argmax())
        found.append(points[best])
        directions = directions[np.abs(directions @ points[best]) < VOTED_COSINE]
    return _proper(np.array(found))


def class_of_arcs(normals: FloatArray, directions: FloatArray, max_sine: float) -> IntArray:
    """(A,) which of (3, 3) directions each arc may have; -1 for none."""
    sine = np.abs(normals @ directions.T)
    return np.where(sine.min(axis=1) < max_sine, sine.argmin(axis=1), -1)


def class_of_lines(lines: FloatArray, directions: FloatArray, min_cosine: float) -> IntArray:
    """(L,) which of (3, 3) directions each line of (L, 3) directions has; -1 for none."""
    cosine = np.abs(lines @ directions.T)
    return np.where(cosine.max(axis=1) > min_cosine, cosine.argmax(axis=1), -1)


def nearest_points(rays: FloatArray, points: FloatArray) -> Array:
    """(R,) index of the nearest of (P, 3) unit points to each of (R, 3) unit rays."""
    return np.asarray((rays @ points.T).argmax(axis=1))
