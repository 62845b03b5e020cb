"""Points along the pieces of one frame, in chains, and their depths made to agree along each."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solveh_banded
from scipy.spatial import cKDTree

from roel_service.arrays import Array, FloatArray, IntArray

# Points lie this far apart along a piece; of two nearer than the second, from two pieces on one
# edge, one stays.
SPACING_PX = 3.0
MIN_SPACING_PX = 2.0
# Neighbours of a chain are no farther apart, no farther aside, and run along each other.
LINK_PX = 8.0
LINK_ASIDE_PX = 2.5
MAX_LINK_SLOPE = 0.7
MIN_LINK_COSINE = 0.75
MIN_POINT_COUNT = 6
# How much neighbouring depths may bend, as a share: a circle of a tenth of its distance, looked at
# along its plane, bends by this times the squared angle between points.
BENDING = 10.0
# Residual at which the robust loss of the depths starts to bend, px, and steps of reweighting.
DEPTH_LOSS_PX = 0.7
DEPTH_STEP_COUNT = 8
RIDGE = 1e-6


def points_along(segments_px: FloatArray) -> tuple[FloatArray, IntArray]:
    """(n, 2) px, evenly along each of (S, 2, 2) pieces, both ends included; and (n,) the piece."""
    step = segments_px[:, 1] - segments_px[:, 0]
    counts = np.maximum(2, np.rint(np.linalg.norm(step, axis=1) / SPACING_PX).astype(np.int64) + 1)
    piece = np.repeat(np.arange(len(counts)), counts)
    place = np.arange(len(piece)) - np.repeat(np.cumsum(counts) - counts, counts)
    share = (place / (counts[piece] - 1))[:, None]
    return segments_px[piece, 0] + share * step[piece], piece


def thinned(points_px: FloatArray, weight: FloatArray) -> IntArray:
    """Indices of points that keep their distance, those of the largest weight first."""
    neighbours = cKDTree(points_px).query_ball_point(points_px, MIN_SPACING_PX)
    kept = np.zeros(len(points_px), dtype=bool)
    for k in np.argsort(-weight, kind="stable"):
        kept[k] = not kept[neighbours[k]].any()
    return np.flatnonzero(kept)


def linked(points_px: FloatArray, tangents: FloatArray) -> list[IntArray]:
    """Chains of points: each point with the best one before and behind it, where both agree.

    Args:
        points_px: (n, 2).
        tangents: (n, 2) unit vectors; the sign does not matter.

    Returns:
        Indices in order, `MIN_POINT_COUNT` or more a chain.
    """
    beside = _best_neighbours(points_px, tangents)
    mutual = [
        [j if j >= 0 and i in beside[j] else -1 for j in beside[i]] for i in range(len(points_px))
    ]
    seen = np.zeros(len(points_px), dtype=bool)
    chains = []
    for first in range(len(points_px)):
        if not seen[first]:
            seen[first] = True
            back, ahead = (_walk(mutual, seen, first, side) for side in (0, 1))
            chains.append(np.array([*back[::-1], first, *ahead]))
    return [chain for chain in chains if len(chain) >= MIN_POINT_COUNT]


def _best_neighbours(points_px: FloatArray, tangents: FloatArray) -> IntArray:
    """(n, 2) the best neighbour behind and ahead of each point, along its tangent; -1 for none."""
    best = np.full((len(points_px), 2), -1, np.int64)
    pairs = cKDTree(points_px).query_pairs(LINK_PX, output_type="ndarray")
    a, b = np.concatenate([pairs, pairs[:, ::-1]]).T
    step = points_px[b] - points_px[a]
    along = np.sum(step * tangents[a], axis=1)
    aside = np.abs(step[:, 0] * tangents[a, 1] - step[:, 1] * tangents[a, 0])
    parallel = np.abs(np.sum(tangents[a] * tangents[b], axis=1)) > MIN_LINK_COSINE
    fits = parallel & (aside <= np.minimum(LINK_ASIDE_PX, MAX_LINK_SLOPE * np.abs(along)))
    a, b, along = a[fits], b[fits], along[fits]
    cost = np.linalg.norm(step[fits], axis=1) + aside[fits]
    # The last one written stays: worst first.
    order = np.lexsort([b, cost])[::-1]
    best[a[order], (along[order] > 0).astype(np.intp)] = b[order]
    return best


def _walk(mutual: list[list[int]], seen: Array, first: int, side: int) -> list[int]:
    """From a point on to one side, as far as nobody was before."""
    walked: list[int] = []
    before, current = first, mutual[first][side]
    while current >= 0 and not seen[current]:
        seen[current] = True
        walked.append(current)
        one, other = mutual[current]
        before, current = current, other if one == before else one
    return walked


def smoothed(
    inverse_depth: FloatArray, information: FloatArray, support: IntArray, angle_rad: float
) -> tuple[FloatArray, FloatArray]:
    """Inverse depths along a chain, each from its own evidence and its neighbours'.

    Where an edge runs along the camera's motion nothing tells its depth but what is before and
    behind it; and where a point took its depth from another edge, its neighbours outvote it.

    Args:
        inverse_depth: (n,) 1/m, of each point by itself.
        information: (n,) px^2 m^2; 0 for a point without a depth.
        support: (n,) observations behind the information.
        angle_rad: between neighbouring points.

    Returns:
        (n,) inverse depths, and (n,) px by which the points' own depths deviate, infinite for those
        that have none.
    """
    has_depth = information > 0
    if not has_depth.any():
        return inverse_depth, np.full(len(inverse_depth), np.inf)
    pixels_per_unit = np.sqrt(information / np.maximum(support, 1))
    smooth = np.full(len(inverse_depth), np.median(inverse_depth[has_depth]))
    stiffness = 1.0 / (BENDING * angle_rad**2 * smooth[0]) ** 2
    stiff = stiffness * _bending_bands(len(inverse_depth))
    # Two points hold a chain; the ridge keeps it regular where they have no weight.
    stiff[2] += RIDGE * information.max()
    weight = information
    deviation_px = np.full(len(inverse_depth), np.inf)
    for _ in range(DEPTH_STEP_COUNT):
        system = stiff.copy()
        system[2] += weight
        smooth = solveh_banded(system, weight * inverse_depth)
        deviation_px = np.where(has_depth, np.abs(inverse_depth - smooth) * pixels_per_unit, np.inf)
        weight = information / (1.0 + (deviation_px / DEPTH_LOSS_PX) ** 2)
    return smooth, deviation_px


def _bending_bands(count: int) -> FloatArray:
    """(3, count) upper bands of D^T D, D the second differences of `count` values."""
    bands = np.zeros((3, count))
    for i, first in enumerate((1.0, -2.0, 1.0)):
        for j, second in enumerate((1.0, -2.0, 1.0)):
            if j >= i:
                bands[2 - (j - i), j : count - 2 + j] += first * second
    return bands
