"""Loop over the pixels of an event sensor between two pictures."""

from __future__ import annotations

import numba
import numpy as np

from roel_service.arrays import Array


@numba.njit(cache=True, nogil=True)
def emit(
    level: Array,
    start_us: float,
    stop_us: float,
    threshold: Array,
    refractory_us: float,
    before: Array,
    reference: Array,
    last_us: Array,
) -> tuple[Array, Array, Array, Array]:
    """Events of all pixels while their level moves linearly between two pictures.

    An event falls whenever the level is a threshold away from the reference, which then moves by
    the threshold; within the refractory time after an event the reference moves but is silent.

    Args:
        level: (H, W) log intensity at `stop_us`.
        threshold: (2, H, W) of negative and positive events.
        before: (H, W) log intensity at `start_us`; overwritten by `level`.
        reference: (H, W) updated.
        last_us: (H, W) time of each pixel's last event, updated.

    Returns:
        Times (n,) in us, columns, rows and polarities, in the order of the pixels.
    """
    capacity = 1024
    t_us, x = np.empty(capacity), np.empty(capacity, np.uint16)
    y, polarity = np.empty(capacity, np.uint16), np.empty(capacity, np.int8)
    count = 0
    height, width = level.shape
    for row in range(height):
        for column in range(width):
            change = level[row, column] - before[row, column]
            side = 1 if change > 0 else 0
            step = threshold[side, row, column] if side else -threshold[side, row, column]
            while change != 0.0:
                target = reference[row, column] + step
                share = (target - before[row, column]) / change
                if share > 1.0:
                    break
                reference[row, column] = target
                moment = start_us + max(share, 0.0) * (stop_us - start_us)
                if moment - last_us[row, column] < refractory_us:
                    continue
                last_us[row, column] = moment
                if count == capacity:
                    t_us = np.concatenate((t_us, np.empty(capacity)))
                    x = np.concatenate((x, np.empty(capacity, np.uint16)))
                    y = np.concatenate((y, np.empty(capacity, np.uint16)))
                    polarity = np.concatenate((polarity, np.empty(capacity, np.int8)))
                    capacity *= 2
                t_us[count], x[count], y[count] = moment, column, row
                polarity[count] = 1 if side else -1
                count += 1
            before[row, column] = level[row, column]
    return t_us[:count], x[:count], y[:count], polarity[:count]
