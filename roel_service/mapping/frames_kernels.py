"""Loops over events: undistortion, rotation compensation, images."""

from __future__ import annotations

import numba
import numpy as np

from roel_service.arrays import Array


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


@numba.njit(cache=True, nogil=True)
def splat(xy_px: Array, polarity: Array, images: Array) -> None:
    """Add each event to the image of its polarity, spread over four pixels.

    Args:
        xy_px: (K, 2) float32.
        polarity: (K,) int8.
        images: (2, H, W) float32, negative and positive; added to.
    """
    height, width = images.shape[1:]
    for k in range(len(xy_px)):
        # NaN fails the comparison, too.
        if not (0.0 <= xy_px[k, 0] < width - 1 and 0.0 <= xy_px[k, 1] < height - 1):
            continue
        column = int(xy_px[k, 0])
        row = int(xy_px[k, 1])
        fx = xy_px[k, 0] - column
        fy = xy_px[k, 1] - row
        image = images[1 if polarity[k] > 0 else 0]
        image[row, column] += (1 - fx) * (1 - fy)
        image[row, column + 1] += fx * (1 - fy)
        image[row + 1, column] += (1 - fx) * fy
        image[row + 1, column + 1] += fx * fy


@numba.njit(cache=True, nogil=True)
def latest(xy_px: Array, polarity: Array, t_us: Array, images: Array) -> None:
    """Write the time of the last event at each pixel, a polarity each.

    Args:
        xy_px: (K, 2) float32.
        polarity: (K,) int8.
        t_us: (K,) int64, non-decreasing.
        images: (2, H, W) int64, negative and positive; untouched where no event fell.
    """
    height, width = images.shape[1:]
    for k in range(len(xy_px)):
        column = np.floor(xy_px[k, 0] + 0.5)
        row = np.floor(xy_px[k, 1] + 0.5)
        if 0 <= column < width and 0 <= row < height:
            images[1 if polarity[k] > 0 else 0, int(row), int(column)] = t_us[k]
