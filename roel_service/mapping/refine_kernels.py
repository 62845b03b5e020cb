"""Loops over the observations of each line: residuals and normal equations of the quadratic forms.

Symbols: a line has Pluecker coordinates y = (v, m) about its own origin. A camera with rotation R
(world from camera) and centre c, about the same origin, sees it as v_c = R^T v and
m_c = R^T (m - c x v). An observation with form G (6, 6), in its camera frame, costs
y_c^T G y_c / |m_c|^2; for a line through the camera's centre that is not a number, as in NumPy.
"""

from __future__ import annotations

import numba
import numpy as np

from roel_service.arrays import Array


@numba.njit(cache=True, nogil=True, error_model="numpy")
def into_camera(R: Array, cx: float, cy: float, cz: float, v: Array, m: Array, out: Array) -> None:
    """Write (v_c, m_c) of one line to `out` (6,)."""
    a = m[0] - (cy * v[2] - cz * v[1])
    b = m[1] - (cz * v[0] - cx * v[2])
    c = m[2] - (cx * v[1] - cy * v[0])
    for i in range(3):
        out[i] = R[0, i] * v[0] + R[1, i] * v[1] + R[2, i] * v[2]
        out[3 + i] = R[0, i] * a + R[1, i] * b + R[2, i] * c


@numba.njit(cache=True, nogil=True, error_model="numpy")
def end_residuals(
    offsets: Array,
    origin: Array,
    v: Array,
    m: Array,
    centre: Array,
    end_rays: Array,
    observation: Array,
    focal_px: float,
) -> Array:
    """(S,) the larger distance of the observed ends from the line's image, as angle times f.

    Args:
        offsets: (L + 1,) rows of each line.
        origin: (L, 3) m, world, about which `m` is taken.
        v, m: (L, 3).
        centre: (M, 3) camera centres of all observations, m, world.
        end_rays: (M, 2, 3) unit rays of their ends, world.
        observation: (S,) of each row.
    """
    residual = np.empty(len(observation))
    for line in range(len(v)):
        for row in range(offsets[line], offsets[line + 1]):
            k = observation[row]
            cx = centre[k, 0] - origin[line, 0]
            cy = centre[k, 1] - origin[line, 1]
            cz = centre[k, 2] - origin[line, 2]
            a = m[line, 0] - (cy * v[line, 2] - cz * v[line, 1])
            b = m[line, 1] - (cz * v[line, 0] - cx * v[line, 2])
            c = m[line, 2] - (cx * v[line, 1] - cy * v[line, 0])
            norm = np.sqrt(a * a + b * b + c * c)
            first = abs(end_rays[k, 0, 0] * a + end_rays[k, 0, 1] * b + end_rays[k, 0, 2] * c)
            second = abs(end_rays[k, 1, 0] * a + end_rays[k, 1, 1] * b + end_rays[k, 1, 2] * c)
            residual[row] = focal_px * max(first, second) / norm
    return residual


@numba.njit(cache=True, nogil=True, error_model="numpy")
def form_cost(
    offsets: Array,
    origin: Array,
    v: Array,
    m: Array,
    rotation: Array,
    centre: Array,
    frame: Array,
    observation: Array,
    forms: Array,
    weight: Array,
    quartic: bool,
) -> Array:
    """(L,) the cost alone; arguments as in `form_system`."""
    cost = np.zeros(len(v))
    y = np.empty(6)
    for line in range(len(v)):
        for row in range(offsets[line], offsets[line + 1]):
            if weight[row] == 0.0:
                continue
            k = observation[row]
            cx = centre[k, 0] - origin[line, 0]
            cy = centre[k, 1] - origin[line, 1]
            cz = centre[k, 2] - origin[line, 2]
            into_camera(rotation[frame[k]], cx, cy, cz, v[line], m[line], y)
            squared = y[3] * y[3] + y[4] * y[4] + y[5] * y[5]
            value = 0.0
            for i in range(6):
                for j in range(6):
                    value += y[i] * forms[k, i, j] * y[j]
            quotient = value / squared
            cost[line] += weight[row] * (quotient * quotient if quartic else quotient)
    return cost


@numba.njit(cache=True, nogil=True, error_model="numpy")
def form_system(
    offsets: Array,
    origin: Array,
    v: Array,
    m: Array,
    jacobian: Array,
    rotation: Array,
    centre: Array,
    frame: Array,
    observation: Array,
    forms: Array,
    weight: Array,
    quartic: bool,
) -> tuple[Array, Array, Array]:
    """Cost, gradient and Gauss-Newton Hessian of each line.

    Args:
        offsets: (L + 1,) rows of each line.
        origin: (L, 3) m, world, about which `m` is taken.
        v, m: (L, 3).
        jacobian: (L, 6, 4) of (v, m) by the line's parameters.
        rotation: (N, 3, 3) world from camera, of the frames.
        centre: (M, 3) camera centres of all observations, m, world.
        frame: (M,) of all observations.
        observation: (S,) of each row.
        forms: (M, 6, 6) of all observations, camera frame.
        weight: (S,) of each row; rows of weight zero are passed over.
        quartic: the cost of a row is its weight times the square of what it is otherwise.

    Returns:
        (L,), (L, 4) and (L, 4, 4).
    """
    line_count = len(v)
    cost = np.zeros(line_count)
    gradient = np.zeros((line_count, 4))
    hessian = np.zeros((line_count, 4, 4))
    y = np.empty(6)
    column = np.empty(6)
    J = np.empty((6, 4))
    GJ = np.empty((6, 4))
    slope = np.empty(4)
    for line in range(line_count):
        for row in range(offsets[line], offsets[line + 1]):
            if weight[row] == 0.0:
                continue
            k = observation[row]
            cx = centre[k, 0] - origin[line, 0]
            cy = centre[k, 1] - origin[line, 1]
            cz = centre[k, 2] - origin[line, 2]
            R = rotation[frame[k]]
            into_camera(R, cx, cy, cz, v[line], m[line], y)
            for p in range(4):
                into_camera(R, cx, cy, cz, jacobian[line, :3, p], jacobian[line, 3:, p], column)
                J[:, p] = column
            for i in range(6):
                for p in range(4):
                    value = 0.0
                    for j in range(6):
                        value += forms[k, i, j] * J[j, p]
                    GJ[i, p] = value
            squared = y[3] * y[3] + y[4] * y[4] + y[5] * y[5]
            value = 0.0
            for i in range(6):
                for j in range(6):
                    value += y[i] * forms[k, i, j] * y[j]
            quotient = value / squared
            cost[line] += weight[row] * (quotient * quotient if quartic else quotient)
            scale = weight[row] * (2.0 * quotient if quartic else 1.0) / squared
            bend = 4.0 * weight[row] / (squared * squared) if quartic else 0.0
            for p in range(4):
                value = 0.0
                for i in range(6):
                    value += y[i] * GJ[i, p]
                # The quotient's own derivative: its denominator grows too.
                pull = y[3] * J[3, p] + y[4] * J[4, p] + y[5] * J[5, p]
                slope[p] = value - quotient * pull
                gradient[line, p] += scale * slope[p]
            for p in range(4):
                for q in range(p, 4):
                    value = 0.0
                    for i in range(6):
                        value += J[i, p] * GJ[i, q]
                    hessian[line, p, q] += scale * value + bend * slope[p] * slope[q]
        for p in range(4):
            for q in range(p):
                hessian[line, p, q] = hessian[line, q, p]
    return cost, gradient, hessian
