"""Sweeps over the observed intervals of each line."""

from __future__ import annotations

import numba
import numpy as np

from roel_service.arrays import Array


@numba.njit(cache=True, nogil=True)
def covered_spans(interval_m: Array, offsets: Array, fraction: float) -> Array:
    """(L, 2) from the first to the last place of each line that enough intervals cover.

    Args:
        interval_m: (S, 2) arc lengths, ascending in each row.
        offsets: (L + 1,) rows of each line.
        fraction: enough is this share of the most intervals that cover one place, at least one.

    Returns:
        NaN for a line without intervals of some length.
    """
    spans = np.full((len(offsets) - 1, 2), np.nan)
    for line in range(len(offsets) - 1):
        rows = interval_m[offsets[line] : offsets[line + 1]]
        starts, stops = np.sort(rows[:, 0]), np.sort(rows[:, 1])
        most = sweep(starts, stops, np.inf)[2]
        if most > 0:
            first, last, _ = sweep(starts, stops, max(1.0, fraction * most))
            spans[line, 0], spans[line, 1] = first, last
    return spans


@numba.njit(cache=True, nogil=True)
def sweep(starts: Array, stops: Array, needed: float) -> tuple[float, float, int]:
    """First and last place that at least `needed` intervals cover, and the most that cover one.

    Args:
        starts, stops: (n,) sorted ends of the intervals.
    """
    first, last = np.nan, np.nan
    most, count, opened, closed = 0, 0, 0, 0
    while closed < len(stops):
        place = stops[closed]
        if opened < len(starts):
            place = min(place, starts[opened])
        while opened < len(starts) and starts[opened] == place:
            opened += 1
        while closed < len(stops) and stops[closed] == place:
            closed += 1
        if count >= needed:
            last = place
        count = opened - closed
        most = max(most, count)
        if count >= needed and np.isnan(first):
            first = place
    return first, last, most
