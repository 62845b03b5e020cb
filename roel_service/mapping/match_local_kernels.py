"""Pairwise loops over the lines of neighbouring frames."""

from __future__ import annotations

import numba
import numpy as np

from roel_service.arrays import Array


@numba.njit(cache=True, nogil=True)
def end_distances(segment: Array, line: Array) -> tuple[float, float]:
    """Distances of the two ends of a (2, 2) segment from an infinite line (2, 2), px."""
    dx, dy = line[1, 0] - line[0, 0], line[1, 1] - line[0, 1]
    length = np.sqrt(dx * dx + dy * dy)
    first = abs((segment[0, 1] - line[0, 1]) * dx - (segment[0, 0] - line[0, 0]) * dy) / length
    second = abs((segment[1, 1] - line[0, 1]) * dx - (segment[1, 0] - line[0, 0]) * dy) / length
    return first, second


@numba.njit(cache=True, nogil=True)
def facing_share(segment: Array, line: Array) -> float:
    """Length of `line` that faces the segment, as a share of the shorter of the two."""
    dx, dy = line[1, 0] - line[0, 0], line[1, 1] - line[0, 1]
    squared = dx * dx + dy * dy
    a = ((segment[0, 0] - line[0, 0]) * dx + (segment[0, 1] - line[0, 1]) * dy) / squared
    b = ((segment[1, 0] - line[0, 0]) * dx + (segment[1, 1] - line[0, 1]) * dy) / squared
    overlap = min(max(a, b), 1.0) - max(min(a, b), 0.0)
    length = np.sqrt(squared)
    sx, sy = segment[1, 0] - segment[0, 0], segment[1, 1] - segment[0, 1]
    return float(overlap * length / min(length, np.sqrt(sx * sx + sy * sy)))


@numba.njit(cache=True, nogil=True)
def nearest(
    moved: Array,
    returned: Array,
    group: Array,
    before: Array,
    after: Array,
    polarity_before: Array,
    polarity_after: Array,
    worst_end: bool,
    max_distance_px: float,
    min_overlap: float,
) -> tuple[Array, Array]:
    """The nearest line of the other frame for every line of two frames.

    Args:
        moved: (B, 2, 2) px, earlier lines as expected in the later frame.
        returned: (G, A, 2, 2) px, later lines as expected in each of the earlier frames.
        group: (B,) which of these frames each earlier line is of.
        before, after: (B, 2, 2), (A, 2, 2) px, as observed.
        polarity_before, polarity_after: 0 goes with every polarity.
        worst_end: the distance of two lines is the largest of the four ends'; else the mean over
            both ways of half the larger and half the average distance of the ends.
        max_distance_px: pairs farther apart are no pairs.
        min_overlap: share of the shorter line that must face the other.

    Returns:
        (B,) index into `after` and (A,) index into `before`; -1 where there is none.
    """
    of_before, of_after = np.full(len(before), -1), np.full(len(after), -1)
    least_before = np.full(len(before), max_distance_px)
    least_after = np.full(len(after), max_distance_px)
    for i in range(len(before)):
        for j in range(len(after)):
            if polarity_before[i] * polarity_after[j] < 0:
                continue
            first, second = end_distances(moved[i], after[j])
            if worst_end:
                there = max(first, second)
            else:
                there = 0.5 * (0.5 * max(first, second) + 0.25 * (first + second))
            # The way back only adds to the distance.
            if there >= least_before[i] and there >= least_after[j]:
                continue
            first, second = end_distances(returned[group[i], j], before[i])
            if worst_end:
                distance = max(there, max(first, second))
            else:
                distance = there + 0.5 * (0.5 * max(first, second) + 0.25 * (first + second))
            if distance >= least_before[i] and distance >= least_after[j]:
                continue
            facing = facing_share(moved[i], after[j])
            if facing < min_overlap or facing <= 0.0:
                continue
            if distance < least_before[i]:
                least_before[i], of_before[i] = distance, j
            if distance < least_after[j]:
                least_after[j], of_after[j] = distance, i
    return of_before, of_after
