"""Pairwise loop over projected lines and the observations of one frame."""

from __future__ import annotations

import numba
import numpy as np

from roel_service.arrays import Array


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
