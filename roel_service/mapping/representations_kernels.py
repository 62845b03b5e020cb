"""Loops over the events of a window that draw them.

An event is drawn at the pixel whose square holds it; those outside the image, NaN included, are
left out.
"""

from __future__ import annotations

import numba
import numpy as np

from roel_service.arrays import Array


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


@numba.njit(cache=True, nogil=True)
def threshold_ordinal(xy_px: Array, radius: int, surface: Array) -> None:
    """Write the threshold-ordinal surface of the events, both polarities together.

    Each event is 255 and takes one from all others in its square of (2 radius + 1)^2 pixels, of
    which those older than a few crossings of the square vanish (Glover et al.: below 255 minus
    twice its side).

    Args:
        xy_px: (K, 2) float32, oldest first.
        radius: of the square, px.
        surface: (H, W) uint8, zero; written.
    """
    height, width = surface.shape
    oldest = 255 - 2 * (2 * radius + 1)
    for k in range(len(xy_px)):
        column = np.floor(xy_px[k, 0] + 0.5)
        row = np.floor(xy_px[k, 1] + 0.5)
        if not (0 <= column < width and 0 <= row < height):
            continue
        x, y = int(column), int(row)
        for j in range(max(0, y - radius), min(height, y + radius + 1)):
            for i in range(max(0, x - radius), min(width, x + radius + 1)):
                older = surface[j, i] - 1
                surface[j, i] = older if older >= oldest else 0
        surface[y, x] = 255


@numba.njit(cache=True, nogil=True)
def speed_invariant(xy_px: Array, polarity: Array, radius: int, surfaces: Array) -> None:
    """Write the speed-invariant time surface of the events, a polarity each.

    Each event takes one from all pixels of its square of (2 radius + 1)^2 that are not below its
    own, and becomes (2 radius + 1)^2 itself: a ramp behind every edge, of the same slope at any
    speed (Manderscheid et al.).

    Args:
        xy_px: (K, 2) float32, oldest first.
        polarity: (K,) int8.
        radius: of the square, px; (2 radius + 1)^2 <= 255.
        surfaces: (2, H, W) uint8, negative and positive, zero; written.
    """
    height, width = surfaces.shape[1:]
    newest = (2 * radius + 1) ** 2
    for k in range(len(xy_px)):
        column = np.floor(xy_px[k, 0] + 0.5)
        row = np.floor(xy_px[k, 1] + 0.5)
        if not (0 <= column < width and 0 <= row < height):
            continue
        x, y = int(column), int(row)
        surface = surfaces[1 if polarity[k] > 0 else 0]
        own = surface[y, x]
        for j in range(max(0, y - radius), min(height, y + radius + 1)):
            for i in range(max(0, x - radius), min(width, x + radius + 1)):
                if surface[j, i] >= own and surface[j, i] > 0:
                    surface[j, i] -= 1
        surface[y, x] = newest
