"""Loops over events: a fixed order, undistortion and rotation compensation."""

from __future__ import annotations

import numba
import numpy as np

from roel_service.arrays import Array

# Up to this many events of one time, insertion sort is the fastest.
SHORT_RUN = 32


@numba.njit(cache=True, nogil=True)
def fixed_order(t_us: Array, x: Array, y: Array, polarity: Array) -> Array:
    """(K,) indices that sort events of equal time by row, column and polarity.

    Args:
        t_us: (K,) non-decreasing.
        x, y, polarity: (K,) event columns.
    """
    count = len(t_us)
    place = np.empty(count, np.int64)
    for k in range(count):
        place[k] = (np.int64(y[k]) << 17) + (np.int64(x[k]) << 1) + (polarity[k] > 0)
    order = np.arange(count)
    start = 0
    while start < count:
        stop = start + 1
        while stop < count and t_us[stop] == t_us[start]:
            stop += 1
        if stop - start > SHORT_RUN:
            order[start:stop] = start + np.argsort(place[start:stop], kind="mergesort")
        else:
            for k in range(start + 1, stop):
                i = k
                while i > start and place[order[i - 1]] > place[k]:
                    order[i] = order[i - 1]
                    i -= 1
                order[i] = k
        start = stop
    return order


@numba.njit(cache=True, nogil=True)
def compensate(
    t_us: Array,
    x: Array,
    y: Array,
    ideal_px: Array,
    first_slot_us: int,
    slot_us: int,
    homographies: Array,
    compensated_px: Array,
) -> None:
    """Write where each event would lie, had the camera not turned since the frame's time.

    Args:
        t_us, x, y: (K,) event columns.
        ideal_px: (H, W, 2) float32, ideal pixel of each raw pixel, NaN outside the model.
        first_slot_us: start of the first slot.
        slot_us: length of a slot.
        homographies: (S, 3, 3) ideal pixel at the slot -> ideal pixel at the frame.
        compensated_px: (K, 2) float32, written.
    """
    for k in range(len(t_us)):
        slot = (t_us[k] - first_slot_us) // slot_us
        h = homographies[min(max(slot, 0), len(homographies) - 1)]
        u = ideal_px[y[k], x[k], 0]
        v = ideal_px[y[k], x[k], 1]
        w = h[2, 0] * u + h[2, 1] * v + h[2, 2]
        compensated_px[k, 0] = (h[0, 0] * u + h[0, 1] * v + h[0, 2]) / w
        compensated_px[k, 1] = (h[1, 0] * u + h[1, 1] * v + h[1, 2]) / w
