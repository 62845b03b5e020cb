"""Loops over events and pixels: back-projection, votes, the median inside a mask."""

from __future__ import annotations

import numba
import numpy as np

from roel_service.arrays import Array


@numba.njit(cache=True, nogil=True)
def project_to_far_plane(
    ideal_px: Array,
    slot: Array,
    homographies: Array,
    far_px: Array,
) -> None:
    """Write where each event's ray meets the far plane, as a pixel of the reference view.

    Args:
        ideal_px: (K, 2) float32, undistorted; NaN outside the camera model.
        slot: (K,) int32, which pose.
        homographies: (S, 3, 3) pixel of the pose's camera -> pixel of the reference view.
        far_px: (K, 2) float32, written; NaN where the ray never meets the plane.
    """
    for k in range(len(ideal_px)):
        h = homographies[slot[k]]
        u = ideal_px[k, 0]
        v = ideal_px[k, 1]
        w = h[2, 0] * u + h[2, 1] * v + h[2, 2]
        if w > 0.0:
            far_px[k, 0] = (h[0, 0] * u + h[0, 1] * v + h[0, 2]) / w
            far_px[k, 1] = (h[1, 0] * u + h[1, 1] * v + h[1, 2]) / w
        else:
            far_px[k, 0] = np.nan
            far_px[k, 1] = np.nan


@numba.njit(cache=True, nogil=True)
def vote(far_px: Array, slot: Array, transfers: Array, votes: Array) -> None:
    """Add each ray to the planes of a volume, spread over four pixels.

    Args:
        far_px: (K, 2) float32, pixels on the far plane; NaN adds nothing.
        slot: (K,) int32, which pose.
        transfers: (Z, S, 3) float32 (scale, x, y): pixel on plane = scale * far pixel + (x, y);
            NaN where the plane is not in front of the pose's camera.
        votes: (Z, H, W) float32, added to.
    """
    height, width = votes.shape[1:]
    for z in range(len(transfers)):
        plane = votes[z]
        for k in range(len(far_px)):
            scale, x, y = transfers[z, slot[k]]
            u = scale * far_px[k, 0] + x
            v = scale * far_px[k, 1] + y
            # NaN fails the comparison, too.
            if not (0.0 <= u < width - 1 and 0.0 <= v < height - 1):
                continue
            column = int(u)
            row = int(v)
            fx = u - column
            fy = v - row
            plane[row, column] += (1 - fx) * (1 - fy)
            plane[row, column + 1] += fx * (1 - fy)
            plane[row + 1, column] += (1 - fx) * fy
            plane[row + 1, column + 1] += fx * fy


@numba.njit(cache=True, nogil=True)
def masked_median(values: Array, mask: Array, radius: int) -> Array:
    """The median of the masked values around each masked pixel.

    Args:
        values: (H, W) integers.
        mask: (H, W) bool.
        radius: half the side of the square window, rounded down, px.

    Returns:
        (H, W) as `values`, unchanged outside the mask.
    """
    height, width = values.shape
    result = values.copy()
    window = np.empty((2 * radius + 1) ** 2, values.dtype)
    for row in range(height):
        for column in range(width):
            if not mask[row, column]:
                continue
            count = 0
            for r in range(max(0, row - radius), min(height, row + radius + 1)):
                for c in range(max(0, column - radius), min(width, column + radius + 1)):
                    if mask[r, c]:
                        window[count] = values[r, c]
                        count += 1
            result[row, column] = np.sort(window[:count])[count // 2]
    return result
