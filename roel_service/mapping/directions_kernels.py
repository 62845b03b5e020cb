"""How well uncertain directions go with others, all by all."""

from __future__ import annotations

import numba
import numpy as np

from roel_service.arrays import Array

# Cosine of the largest angle at which a line can have a direction.
MIN_COSINE = 0.5
# Squared Mahalanobis distance beyond which a density is zero to within rounding.
FAR = 150.0


@numba.njit(cache=True, nogil=True)
def densities(directions: Array, line: Array, precision: Array, peak: Array) -> Array:
    """(D, L) densities of L uncertain lines at D directions.

    Args:
        directions, line: (D, 3) and (L, 3) unit vectors; their signs do not matter.
        precision: (L, 3, 3) inverse covariance of each line, zero along it.
        peak: (L,) largest density.
    """
    found = np.zeros((len(directions), len(line)))
    for d in range(len(directions)):
        x, y, z = directions[d]
        for k in range(len(line)):
            if abs(x * line[k, 0] + y * line[k, 1] + z * line[k, 2]) <= MIN_COSINE:
                continue
            P = precision[k]
            across = 2.0 * (x * y * P[0, 1] + x * z * P[0, 2] + y * z * P[1, 2])
            squared = x * x * P[0, 0] + y * y * P[1, 1] + z * z * P[2, 2] + across
            if squared < FAR:
                found[d, k] = peak[k] * np.exp(-0.5 * squared)
    return found
