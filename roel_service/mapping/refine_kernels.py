"""Loops over the observations of each line: residuals and normal equations of the quadratic forms.

Symbols: a line has Pluecker coordinates y = (v, m) about its own origin. A camera with rotation R
(world from camera) and centre c, about the same origin, sees it as v_c = R^T v and
m_c = R^T (m - c x v). An observation with form G (6, 6), in its camera frame, costs
y_c^T G y_c / |m_c|^2; for a line through the camera's centre that is not a number, as in NumPy.
Cameras that stay where they are leave a form of y itself, y^T F y = y_c^T G y_c, and forms of one
line add up before they meet its Jacobian.
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
    offsets: Array, v: Array, m: Array, centre: Array, end_rays: Array, focal_px: float
) -> Array:
    """(S,) the larger distance of the observed ends from the line's image, as angle times f.

    Args:
        offsets: (L + 1,) rows of each line.
        v, m: (L, 3), about the line's origin.
        centre: (S, 3) camera centre of each row, m, world, about the origin of its line.
        end_rays: (S, 2, 3) unit rays of its ends, world.
    """
    residual = np.empty(len(centre))
    for line in range(len(v)):
        for row in range(offsets[line], offsets[line + 1]):
            cx, cy, cz = centre[row]
            a = m[line, 0] - (cy * v[line, 2] - cz * v[line, 1])
            b = m[line, 1] - (cz * v[line, 0] - cx * v[line, 2])
            c = m[line, 2] - (cx * v[line, 1] - cy * v[line, 0])
            norm = np.sqrt(a * a + b * b + c * c)
            first = abs(end_rays[row, 0, 0] * a + end_rays[row, 0, 1] * b + end_rays[row, 0, 2] * c)
            second = abs(
                end_rays[row, 1, 0] * a + end_rays[row, 1, 1] * b + end_rays[row, 1, 2] * c
            )
            residual[row] = focal_px * max(first, second) / norm
    return residual


@numba.njit(cache=True, nogil=True, error_model="numpy")
def direction_cost(v: Array, direction: Array, weight: Array) -> Array:
    """(L,) the cost alone; arguments as in `direction_system`."""
    cost = np.zeros(len(v))
    for line in range(len(v)):
        if weight[line] > 0.0:
            x, y, z = crossed(v[line], direction[line])
            cost[line] = weight[line] * (x * x + y * y + z * z)
    return cost


@numba.njit(cache=True, nogil=True, error_model="numpy")
def direction_system(U: Array, direction: Array, weight: Array) -> tuple[Array, Array, Array]:
    """Cost, gradient and Hessian of w |v x d|^2, the squared sine between line and direction.

    Args:
        U: (L, 3, 3) of the orthonormal form; v is its first column.
        direction: (L, 3) unit vectors d.
        weight: (L,) w.

    Returns:
        (L,), (L, 4) and (L, 4, 4).
    """
    cost = direction_cost(U[:, :, 0], direction, weight)
    gradient = np.zeros((len(U), 4))
    hessian = np.zeros((len(U), 4, 4))
    for line in range(len(U)):
        if not weight[line] > 0.0:
            continue
        # dv = d3 u2 - d2 u3.
        ax, ay, az = crossed(U[line, :, 0], direction[line])
        bx, by, bz = crossed(U[line, :, 1], direction[line])
        cx, cy, cz = crossed(U[line, :, 2], direction[line])
        w = weight[line]
        gradient[line, 1] = -w * (ax * cx + ay * cy + az * cz)
        gradient[line, 2] = w * (ax * bx + ay * by + az * bz)
        hessian[line, 1, 1] = w * (cx * cx + cy * cy + cz * cz)
        hessian[line, 2, 2] = w * (bx * bx + by * by + bz * bz)
        hessian[line, 1, 2] = hessian[line, 2, 1] = -w * (bx * cx + by * cy + bz * cz)
    return cost, gradient, hessian


@numba.njit(cache=True, nogil=True, error_model="numpy")
def crossed(a: Array, b: Array) -> tuple[float, float, float]:
    """The product a x b."""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def turned(R: Array, A: Array, half: Array, out: Array) -> None:
    """Write R A R^T to `out` (3, 3), by way of `half` (3, 3)."""
    for i in range(3):
        for j in range(3):
            half[i, j] = R[i, 0] * A[0, j] + R[i, 1] * A[1, j] + R[i, 2] * A[2, j]
    for i in range(3):
        for j in range(3):
            out[i, j] = half[i, 0] * R[j, 0] + half[i, 1] * R[j, 1] + half[i, 2] * R[j, 2]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def add_crossed(c: Array, A: Array, out: Array) -> None:
    """Add [c]x A to `out` (3, 3)."""
    for j in range(3):
        out[0, j] += c[1] * A[2, j] - c[2] * A[1, j]
        out[1, j] += c[2] * A[0, j] - c[0] * A[2, j]
        out[2, j] += c[0] * A[1, j] - c[1] * A[0, j]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def world_forms(
    centre: Array,
    rotation: Array,
    frame: Array,
    observation: Array,
    segment_forms: Array,
    event_forms: Array,
    segment_weight: float,
    event_weight: float,
) -> Array:
    """(S, 6, 6) weighted sums of two forms, of lines about their own origins, in the world.

    Args:
        centre: (S, 3) camera centre of each row, m, world, about the origin of its line.
        rotation: (N, 3, 3) world from camera, of the frames.
        frame: (M,) of all observations.
        observation: (S,) of each row.
        segment_forms, event_forms: (M, 6, 6) of all observations, camera frame.
    """
    found = np.empty((len(observation), 6, 6))
    form, half = np.empty((6, 6)), np.empty((3, 3))
    for row in range(len(observation)):
        k = observation[row]
        R = rotation[frame[k]]
        for i in range(6):
            for j in range(6):
                form[i, j] = segment_weight * segment_forms[k, i, j]
                form[i, j] += event_weight * event_forms[k, i, j]
        c, vv, vm, mm = centre[row], found[row, :3, :3], found[row, :3, 3:], found[row, 3:, 3:]
        turned(R, form[:3, :3], half, vv)
        turned(R, form[:3, 3:], half, vm)
        turned(R, form[3:, 3:], half, mm)
        # With y_c = (v, m - [c]x v): F_vm = G_vm + [c]x G_mm, F_vv = G_vv + [c]x G_mv - F_vm [c]x.
        add_crossed(c, vm.T, vv)
        add_crossed(c, mm, vm)
        add_crossed(c, vm.T, vv.T)
        found[row, 3:, :3] = vm.T
    return found


@numba.njit(cache=True, nogil=True, error_model="numpy")
def form_cost(
    offsets: Array, v: Array, m: Array, centre: Array, forms: Array, weight: Array, quartic: bool
) -> Array:
    """(L,) the cost alone; arguments as in `form_system`."""
    cost = np.zeros(len(v))
    for line in range(len(v)):
        for row in range(offsets[line], offsets[line + 1]):
            if weight[row] == 0.0:
                continue
            value, squared = 0.0, 0.0
            for i in range(3):
                j, k = (i + 1) % 3, (i + 2) % 3
                seen = m[line, i] - centre[row, j] * v[line, k] + centre[row, k] * v[line, j]
                squared += seen * seen
            for i in range(3):
                pull, turn = 0.0, 0.0
                for j in range(3):
                    pull += forms[row, i, j] * v[line, j] + forms[row, i, j + 3] * m[line, j]
                    turn += (
                        forms[row, j, i + 3] * v[line, j] + forms[row, i + 3, j + 3] * m[line, j]
                    )
                value += v[line, i] * pull + m[line, i] * turn
            quotient = value / squared
            cost[line] += weight[row] * (quotient * quotient if quartic else quotient)
    return cost


@numba.njit(cache=True, nogil=True, error_model="numpy")
def form_system(
    offsets: Array,
    v: Array,
    m: Array,
    jacobian: Array,
    centre: Array,
    forms: Array,
    weight: Array,
    quartic: bool,
) -> tuple[Array, Array, Array]:
    """Cost, gradient and Gauss-Newton Hessian of each line.

    Args:
        offsets: (L + 1,) rows of each line.
        v, m: (L, 3), about the line's origin.
        jacobian: (L, 6, 4) of (v, m) by the line's parameters.
        centre: (S, 3) camera centre of each row, m, world, about the origin of its line.
        forms: (S, 6, 6) `world_forms`.
        weight: (S,) of each row; rows of weight zero are passed over.
        quartic: the cost of a row is its weight times the square of what it is otherwise.

    Returns:
        (L,), (L, 4) and (L, 4, 4).
    """
    line_count = len(v)
    cost = np.zeros(line_count)
    gradient = np.zeros((line_count, 4))
    hessian = np.zeros((line_count, 4, 4))
    y, seen, slope = np.empty(6), np.empty(3), np.empty(6)
    by_y, by_ys = np.empty(6), np.empty((6, 6))
    for line in range(line_count):
        y[:3], y[3:] = v[line], m[line]
        by_y[:], by_ys[:] = 0.0, 0.0
        for row in range(offsets[line], offsets[line + 1]):
            if weight[row] == 0.0:
                continue
            c = centre[row]
            seen[0] = y[3] - (c[1] * y[2] - c[2] * y[1])
            seen[1] = y[4] - (c[2] * y[0] - c[0] * y[2])
            seen[2] = y[5] - (c[0] * y[1] - c[1] * y[0])
            squared = seen[0] * seen[0] + seen[1] * seen[1] + seen[2] * seen[2]
            value = 0.0
            for i in range(6):
                slope[i] = 0.0
                for j in range(6):
                    slope[i] += forms[row, i, j] * y[j]
                value += y[i] * slope[i]
            quotient = value / squared
            cost[line] += weight[row] * (quotient * quotient if quartic else quotient)
            scale = weight[row] * (2.0 * quotient if quartic else 1.0) / squared
            bend = 4.0 * weight[row] / (squared * squared) if quartic else 0.0
            # The quotient's own derivative: its denominator grows too.
            slope[0] -= quotient * (c[1] * seen[2] - c[2] * seen[1])
            slope[1] -= quotient * (c[2] * seen[0] - c[0] * seen[2])
            slope[2] -= quotient * (c[0] * seen[1] - c[1] * seen[0])
            for i in range(3):
                slope[i + 3] -= quotient * seen[i]
            for i in range(6):
                by_y[i] += scale * slope[i]
                for j in range(i, 6):
                    by_ys[i, j] += scale * forms[row, i, j]
                    if quartic:
                        by_ys[i, j] += bend * slope[i] * slope[j]
        by_parameters(jacobian[line], by_y, by_ys, gradient[line], hessian[line])
    return cost, gradient, hessian


@numba.njit(cache=True, nogil=True, error_model="numpy")
def by_parameters(J: Array, by_y: Array, by_ys: Array, gradient: Array, hessian: Array) -> None:
    """Write J^T g (4,) and J^T H J (4, 4); of H the upper triangle is read."""
    for p in range(4):
        for i in range(6):
            gradient[p] += J[i, p] * by_y[i]
            pulled = 0.0
            for j in range(6):
                pulled += (by_ys[i, j] if j >= i else by_ys[j, i]) * J[j, p]
            for q in range(p + 1):
                hessian[q, p] += J[i, q] * pulled
    for p in range(4):
        for q in range(p):
            hessian[p, q] = hessian[q, p]
