"""Directions that many lines share, in a map and in a panorama; no right angles are assumed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from roel_service.arrays import Array, FloatArray
from roel_service.geometry.vectors import unit
from roel_service.pano_loc.arcs import PanoramaArcs

MAX_MAP_DIRECTION_COUNT = 8
MAX_PICTURE_DIRECTION_COUNT = 8
# A shared direction has at least this share of all length.
MIN_LENGTH_SHARE = 0.03
# Width of the vote, and how far a line may be off the direction that it belongs to.
VOTE_WIDTH_RAD = np.deg2rad(2.0)
MEMBER_RAD = np.deg2rad(6.0)
# Directions are sought among those of this many longest lines, or crossings of longest arcs.
CANDIDATE_LINE_COUNT = 400
CROSSED_ARC_COUNT = 40
# Circles closer than this cross anywhere.
MIN_CROSSING_SINE = np.sin(np.deg2rad(5.0))
ROUND_COUNT = 8

Deviation = Callable[[FloatArray], FloatArray]


def shared_directions(directions: FloatArray, length: FloatArray) -> FloatArray:
    """(D, 3) unit directions shared by lines, strongest first.

    Args:
        directions: (L, 3) unit, undirected.
        length: (L,) weights.
    """
    candidates = directions[np.argsort(-length, kind="stable")[:CANDIDATE_LINE_COUNT]]
    return _strongest(
        candidates,
        length,
        MAX_MAP_DIRECTION_COUNT,
        deviation=lambda v: np.sqrt(np.maximum(0.0, 1.0 - (directions @ v.T) ** 2)),
        scatter=directions[:, :, None] * directions[:, None, :],
        largest=True,
    )


def vanishing_directions(arcs: PanoramaArcs) -> FloatArray:
    """(D, 3) unit directions that many arcs of a panorama may have, strongest first.

    An arc may have any direction normal to its own normal: shared directions are where many of the
    arcs' circles cross.
    """
    first, second = np.triu_indices(min(len(arcs), CROSSED_ARC_COUNT), k=1)
    crossing = np.cross(arcs.normals[first], arcs.normals[second])
    length = np.linalg.norm(crossing, axis=1)
    clear = length > MIN_CROSSING_SINE
    return _strongest(
        crossing[clear] / length[clear, None],
        arcs.length_rad,
        MAX_PICTURE_DIRECTION_COUNT,
        deviation=lambda v: np.abs(arcs.normals @ v.T),
        scatter=arcs.normals[:, :, None] * arcs.normals[:, None, :],
        largest=False,
    )


def _strongest(
    candidates: FloatArray,
    length: FloatArray,
    max_count: int,
    *,
    deviation: Deviation,
    scatter: FloatArray,
    largest: bool,
) -> FloatArray:
    """Directions with the most length near them; who belongs to one has no vote for the next.

    Args:
        candidates: (C, 3) unit.
        length: (L,) votes.
        max_count: directions at the most.
        deviation: (L, V) sines of the angles by which lines are off (V, 3) directions.
        scatter: (L, 3, 3) of each line, of which the direction is an eigenvector.
        largest: whether it is that of the largest eigenvalue, or of the least.
    """
    found: list[FloatArray] = []
    votes = length.copy()
    # Which candidate is best needs no more than single precision.
    support = _vote(deviation(candidates).astype(np.float32))
    while len(candidates) and len(found) < max_count:
        direction = candidates[np.argmax(votes @ support)]
        for _ in range(ROUND_COUNT):
            weight = votes * _vote(deviation(direction[None])[:, 0])
            vectors = np.linalg.eigh(np.einsum("l,lij->ij", weight, scatter))[1]
            direction = vectors[:, -1 if largest else 0]
        off = deviation(direction[None])[:, 0]
        if votes @ _vote(off) < MIN_LENGTH_SHARE * length.sum():
            break
        found.append(direction)
        votes = np.where(off < np.sin(MEMBER_RAD), 0.0, votes)
    return np.array(found).reshape(-1, 3)


def _vote(sine: Array) -> Array:
    return np.asarray(np.exp(-0.5 * (sine / np.float32(np.sin(VOTE_WIDTH_RAD))) ** 2))


def class_of(directions: FloatArray, shared: FloatArray) -> Array:
    """(L,) int64, the shared direction that each line has; -1 for none."""
    if len(shared) == 0:
        return np.full(len(directions), -1)
    sine = np.sqrt(np.maximum(0.0, 1.0 - (directions @ shared.T) ** 2))
    nearest = sine.argmin(axis=1)
    return np.where(sine.min(axis=1) < np.sin(MEMBER_RAD), nearest, -1)


def principal_frame(shared: FloatArray, directions: FloatArray) -> FloatArray:
    """(3, 3) rotation whose rows are axes that follow the shared directions, strongest first.

    Args:
        shared: (D, 3) unit.
        directions: (L, 3) unit, of all lines, longest first: where fewer than two are shared, they say
            what turns with the map.
    """
    rows: list[FloatArray] = []
    for direction in [*shared, *directions, *np.eye(3)]:
        rest = direction - sum((row @ direction) * row for row in rows)
        if len(rows) < 2 and np.linalg.norm(rest) > MIN_CROSSING_SINE:
            rows.append(unit(rest))
    return np.stack([*rows, np.cross(rows[0], rows[1])])
