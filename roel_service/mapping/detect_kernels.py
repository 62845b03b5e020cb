"""Pairwise loop over the lines of one frame."""

from __future__ import annotations

import numba
import numpy as np

from roel_service.arrays import Array


@numba.njit(cache=True, nogil=True)
def keep_first(segments: Array, labels: Array, max_distance: float, min_overlap: float) -> Array:
    """Which segments lie along none of the kept ones before them.

    Args:
        segments: (S, 2, 2) px, best first.
        labels: (S,) only equal labels are compared.
        max_distance: largest distance of both ends from the other's infinite line, px.
        min_overlap: smallest share of the segment that faces the other one.

    Returns:
        (S,) bool.
    """
    kept = np.ones(len(segments), np.bool_)
    for i in range(len(segments)):
        for j in range(i):
            if not kept[j] or labels[i] != labels[j]:
                continue
            px, py = segments[j, 0, 0], segments[j, 0, 1]
            dx, dy = segments[j, 1, 0] - px, segments[j, 1, 1] - py
            length = np.sqrt(dx * dx + dy * dy)
            dx, dy = dx / length, dy / length
            ax, ay = segments[i, 0, 0] - px, segments[i, 0, 1] - py
            bx, by = segments[i, 1, 0] - px, segments[i, 1, 1] - py
            if abs(ax * dy - ay * dx) > max_distance or abs(bx * dy - by * dx) > max_distance:
                continue
            a, b = ax * dx + ay * dy, bx * dx + by * dy
            low, high = min(a, b), max(a, b)
            facing = min(high, length) - max(low, 0.0)
            if facing > 0.0 and facing >= min_overlap * (high - low):
                kept[i] = False
                break
    return kept
