"""Loops over the lines and the observations of one frame."""

from __future__ import annotations

import numba
import numpy as np

from roel_service.arrays import Array


@numba.njit(cache=True, nogil=True)
def projected_segments(
    spans: Array,
    rotation: Array,
    translation: Array,
    K: Array,
    size_px: tuple[int, int],
    near_share: float,
    least_depth_m: float,
    min_length_px: float,
) -> Array:
    """(L, 2, 2) px of 3D segments in one camera; NaN where nothing of them is in its image.

    Args:
        spans: (L, 2, 3) endpoints, m, world.
        rotation, translation: (3, 3) and (3,) camera from world.
        K: (3, 3) calibration matrix without skew, px.
        size_px: width and height.
        near_share: segments are cut this far in front of the camera, as a share of their farther
            end's depth, ...
        least_depth_m: ... and at least so far.
        min_length_px: shorter projections are left out.
    """
    found = np.full((len(spans), 2, 2), np.nan)
    ends, pixels = np.empty((2, 3)), np.empty((2, 2))
    for line in range(len(spans)):
        for end in range(2):
            x, y, z = spans[line, end]
            for i in range(3):
                turned = rotation[i, 0] * x + rotation[i, 1] * y + rotation[i, 2] * z
                ends[end, i] = turned + translation[i]
        near = max(near_share * max(abs(ends[0, 2]), abs(ends[1, 2])), least_depth_m)
        # Said so that what is not a number is not in view.
        if not (ends[0, 2] >= near or ends[1, 2] >= near):
            continue
        for end in range(2):
            if ends[end, 2] < near:
                share = (near - ends[end, 2]) / (ends[1 - end, 2] - ends[end, 2])
                for i in range(3):
                    ends[end, i] += share * (ends[1 - end, i] - ends[end, i])
        for end in range(2):
            for i in range(2):
                pixels[end, i] = ends[end, i] / ends[end, 2] * K[i, i] + K[i, 2]
        is_seen = (
            np.hypot(pixels[1, 0] - pixels[0, 0], pixels[1, 1] - pixels[0, 1]) >= min_length_px
        )
        for i in range(2):
            low, high = min(pixels[0, i], pixels[1, i]), max(pixels[0, i], pixels[1, i])
            is_seen = is_seen and high >= 0.0 and low < size_px[i]
        if is_seen:
            found[line] = pixels
    return found


@numba.njit(cache=True, nogil=True)
def observations_along(
    projected: Array,
    image_line: Array,
    its_rate: Array,
    observed: Array,
    speeds: Array,
    max_distance: float,
    min_overlap: float,
    max_speed_difference: float,
) -> tuple[Array, Array]:
    """Which observations lie along which projected lines.

    Args:
        projected: (L, 2, 2) px, NaN where a line is not in view.
        image_line: (L, 3) a x + b y + c = 0 with a^2 + b^2 = 1.
        its_rate: (L, 3) change of (a, b, c) a ms.
        observed: (M, 2, 2) px.
        speeds: (M,) px/ms along the left-hand normals.
        max_distance: of both ends of an observation from the image line, px.
        min_overlap: share of the observation that faces the projection.
        max_speed_difference: observed against predicted, px/ms.

    Returns:
        Lines (n,) and observations (n,), pairwise.
    """
    count = len(observed)
    left, right = np.empty(count), np.empty(count)
    top, bottom = np.empty(count), np.empty(count)
    for k in range(count):
        left[k] = min(observed[k, 0, 0], observed[k, 1, 0])
        right[k] = max(observed[k, 0, 0], observed[k, 1, 0])
        top[k] = min(observed[k, 0, 1], observed[k, 1, 1])
        bottom[k] = max(observed[k, 0, 1], observed[k, 1, 1])
    lines, members = [], []
    for j in range(len(projected)):
        if np.isnan(projected[j, 0, 0]):
            continue
        a, b, c = image_line[j]
        x0, x1 = projected[j, 0, 0], projected[j, 1, 0]
        y0, y1 = projected[j, 0, 1], projected[j, 1, 1]
        low_x, high_x = min(x0, x1) - max_distance, max(x0, x1) + max_distance
        low_y, high_y = min(y0, y1) - max_distance, max(y0, y1) + max_distance
        # Positions along the image line; its direction is (b, -a).
        p0, p1 = b * x0 - a * y0, b * x1 - a * y1
        low_p, high_p = min(p0, p1), max(p0, p1)
        for k in range(count):
            if right[k] < low_x or left[k] > high_x or bottom[k] < low_y or top[k] > high_y:
                continue
            sx, sy = observed[k, 0]
            ex, ey = observed[k, 1]
            if abs(a * sx + b * sy + c) > max_distance or abs(a * ex + b * ey + c) > max_distance:
                continue
            q0, q1 = b * sx - a * sy, b * ex - a * ey
            facing = min(high_p, max(q0, q1)) - max(low_p, min(q0, q1))
            if facing < min_overlap * abs(q1 - q0):
                continue
            mx, my = 0.5 * (sx + ex), 0.5 * (sy + ey)
            predicted = -(its_rate[j, 0] * mx + its_rate[j, 1] * my + its_rate[j, 2])
            # (a, b) against the observation's left-hand normal (-(ey - sy), ex - sx).
            if -a * (ey - sy) + b * (ex - sx) < 0.0:
                predicted = -predicted
            if abs(speeds[k] - predicted) > max_speed_difference:
                continue
            lines.append(j)
            members.append(k)
    return np.array(lines, dtype=np.int64), np.array(members, dtype=np.int64)
