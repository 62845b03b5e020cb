"""Directions that many lines share, and the rotations that lay those of two maps onto one another."""

from __future__ import annotations

import itertools

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.geometry.se3 import rotation_angle
from roel_service.geometry.vectors import dot, unit

# Lines this near to a direction (cosine) belong to it.
CONE_COSINE = 0.985  # 10 degrees
# Directions of fewer lines, as a share of all length, are none.
MIN_SHARE = 0.05
MAX_DIRECTION_COUNT = 4
# Directions that are tried as the axis of a cone; more only cost time.
SEED_COUNT = 200
# Pairs of directions match if they enclose the same angle within this, and are not parallel.
MAX_ANGLE_OFFSET_RAD = np.radians(6.0)
MIN_PAIR_ANGLE_RAD = np.radians(20.0)
# Rotations closer than this are the same guess.
SAME_ROTATION_RAD = np.radians(8.0)


def dominant_directions(directions: FloatArray, weights: FloatArray) -> FloatArray:
    """(K, 3) unit directions with the most weight about them, best first.

    Args:
        directions: (N, 3) unit vectors; the sign means nothing.
        weights: (N,) such as lengths.
    """
    seeds = directions[np.argsort(-weights, kind="stable")]
    seeds = seeds[:: max(1, len(seeds) // SEED_COUNT)]
    left = weights.copy()
    found: list[FloatArray] = []
    while len(found) < MAX_DIRECTION_COUNT and len(seeds):
        inside = np.abs(directions @ seeds.T) > CONE_COSINE
        votes = left @ inside
        best = int(np.argmax(votes))
        if votes[best] < MIN_SHARE * weights.sum():
            break
        axis = seeds[best]
        for _ in range(2):
            near = np.abs(directions @ axis) > CONE_COSINE
            axis = _principal(directions[near], left[near])
        found.append(axis)
        left[np.abs(directions @ axis) > CONE_COSINE] = 0.0
    return np.array(found).reshape(-1, 3)


def _principal(directions: FloatArray, weights: FloatArray) -> FloatArray:
    """(3,) the axis of undirected unit vectors."""
    second = (directions * weights[:, None]).T @ directions
    return np.asarray(np.linalg.eigh(second)[1][:, -1])


def matching_rotations(source: FloatArray, target: FloatArray) -> FloatArray:
    """(R, 3, 3) rotations that take two of the source's directions to two of the target's.

    Args:
        source, target: (K, 3) unit directions; the sign means nothing.
    """
    a, b = _pairs(source, both_orders=False)
    i, j = _pairs(target, both_orders=True)
    i, j = np.concatenate([i, i]), np.concatenate([j, -j])
    offset = np.abs(_angles(a, b)[:, None] - _angles(i, j))
    known, other = np.nonzero(offset < MAX_ANGLE_OFFSET_RAD)
    rotations = np.swapaxes(_frames(a, b), 1, 2)[known]
    rotations = _frames(i, j)[other] @ rotations
    # Turning both directions around is a rotation as well: half a turn about their normal.
    half_turn = np.diag([-1.0, -1.0, 1.0])
    turned = _frames(i, j)[other] @ half_turn @ np.swapaxes(_frames(a, b), 1, 2)[known]
    found: list[FloatArray] = []
    for rotation in np.concatenate([rotations, turned]):
        if is_new(rotation, found):
            found.append(rotation)
    return np.array(found).reshape(-1, 3, 3)


def _pairs(directions: FloatArray, *, both_orders: bool) -> tuple[FloatArray, FloatArray]:
    """(P, 3) first and (P, 3) second of all pairs that are not near to parallel."""
    indices = itertools.permutations if both_orders else itertools.combinations
    pairs = np.array(list(indices(range(len(directions)), 2)), np.int64).reshape(-1, 2)
    first, second = directions[pairs[:, 0]], directions[pairs[:, 1]]
    angle = _angles(first, second)
    open_ = (angle > MIN_PAIR_ANGLE_RAD) & (angle < np.pi - MIN_PAIR_ANGLE_RAD)
    return first[open_], second[open_]


def _angles(first: FloatArray, second: FloatArray) -> FloatArray:
    return np.asarray(np.arccos(np.clip(dot(first, second), -1.0, 1.0)))


def _frames(first: FloatArray, second: FloatArray) -> FloatArray:
    """(P, 3, 3) rotations with columns along the sum, the difference, and the normal of each pair."""
    x, y = unit(first + second), unit(first - second)
    return np.stack([x, y, np.cross(x, y)], axis=2)


def is_new(rotation: FloatArray, known: list[FloatArray]) -> bool:
    """Whether a rotation is none of the known ones."""
    if not known:
        return True
    return bool((rotation_angle(rotation.T @ np.array(known)) > SAME_ROTATION_RAD).all())
