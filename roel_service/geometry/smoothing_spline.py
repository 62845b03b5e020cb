"""Cubic smoothing splines: curves that stay near points and bend little."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.linalg import solveh_banded

from roel_service.arrays import FloatArray


def smoothing_spline(x: FloatArray, y: FloatArray, stiffness: float) -> CubicSpline:
    """The curve with the least sum of squared distances plus stiffness times the integral of f''^2.

    It is a natural cubic spline; its second derivatives at the points solve a system of five
    diagonals (Reinsch 1967; Green and Silverman 1994, section 2.3).

    Args:
        x: (N,) increasing, N at least 4.
        y: (N, D) values.
        stiffness: not negative; 0 interpolates.
    """
    step = np.diff(x)
    # Second divided differences of a curve g: left g_i + middle g_i+1 + right g_i+2.
    left, right = 1.0 / step[:-1], 1.0 / step[1:]
    middle = -(left + right)
    bands = np.zeros((3, len(x) - 2))
    bands[0] = (step[:-1] + step[1:]) / 3.0 + stiffness * (left**2 + middle**2 + right**2)
    across = stiffness * (middle[:-1] * left[1:] + right[:-1] * middle[1:])
    bands[1, :-1] = step[1:-1] / 6.0 + across
    bands[2, :-2] = stiffness * right[:-2] * left[2:]
    bend = solveh_banded(bands, np.diff(np.diff(y, axis=0) / step[:, None], axis=0), lower=True)
    pull = np.zeros_like(y)
    pull[:-2] += left[:, None] * bend
    pull[1:-1] += middle[:, None] * bend
    pull[2:] += right[:, None] * bend
    return CubicSpline(x, y - stiffness * pull, bc_type="natural")
