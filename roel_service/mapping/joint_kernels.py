"""Loops over the observations of each line: normal equations of lines and poses together.

Symbols as in `refine_kernels`. A pose steps by (r, d), R <- Exp(r) R and c <- c + d, and moves the
line that its camera sees by dv_c = R^T (v x r) and dm_c = R^T (m_o x r + v x d), m_o = m - c x v.
"""

from __future__ import annotations

import numba
import numpy as np

from roel_service.arrays import Array
from roel_service.mapping.refine_kernels import into_camera


@numba.njit(cache=True, nogil=True, error_model="numpy")
def seen_line(
    R: Array, position: Array, origin: Array, v: Array, m: Array, y: Array
) -> tuple[float, float, float]:
    """Write (v_c, m_c) of a line in one camera to `y` (6,).

    Returns:
        The camera's centre about the line's origin.
    """
    cx = position[0] - origin[0]
    cy = position[1] - origin[1]
    cz = position[2] - origin[2]
    into_camera(R, cx, cy, cz, v, m, y)
    return cx, cy, cz


@numba.njit(cache=True, nogil=True, error_model="numpy")
def quotient(form: Array, y: Array) -> tuple[float, float]:
    """y^T G y / |m_c|^2, and |m_c|^2."""
    squared = y[3] * y[3] + y[4] * y[4] + y[5] * y[5]
    value = 0.0
    for i in range(6):
        for j in range(6):
            value += y[i] * form[i, j] * y[j]
    return value / squared, squared


@numba.njit(cache=True, nogil=True, error_model="numpy")
def turned_cross(R: Array, a: Array, out: Array) -> None:
    """Write R^T [a]x to `out` (3, 3)."""
    for i in range(3):
        out[i, 0] = R[1, i] * a[2] - R[2, i] * a[1]
        out[i, 1] = R[2, i] * a[0] - R[0, i] * a[2]
        out[i, 2] = R[0, i] * a[1] - R[1, i] * a[0]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def multiplied(A: Array, D: Array) -> None:
    """A (3, 3) becomes A D."""
    for i in range(3):
        a, b, c = A[i, 0], A[i, 1], A[i, 2]
        for j in range(3):
            A[i, j] = a * D[0, j] + b * D[1, j] + c * D[2, j]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def row_jacobian(
    R: Array,
    centre: tuple[float, float, float],
    v: Array,
    m: Array,
    jacobian: Array,
    by_tangent: Array,
    J: Array,
) -> None:
    """Write how the line's (4) and the tangent's (6) parameters move (v_c, m_c) to `J` (6, 10)."""
    cx, cy, cz = centre
    column, seen = np.empty(6), np.empty(3)
    for p in range(4):
        into_camera(R, cx, cy, cz, jacobian[:3, p], jacobian[3:, p], column)
        J[:, p] = column
    seen[0] = m[0] - (cy * v[2] - cz * v[1])
    seen[1] = m[1] - (cz * v[0] - cx * v[2])
    seen[2] = m[2] - (cx * v[1] - cy * v[0])
    turned_cross(R, v, J[:3, 4:7])
    turned_cross(R, seen, J[3:, 4:7])
    J[:3, 7:] = 0.0
    J[3:, 7:] = J[:3, 4:7]
    multiplied(J[:3, 4:7], by_tangent)
    multiplied(J[3:, 4:7], by_tangent)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def end_residuals(
    offsets: Array,
    origin: Array,
    v: Array,
    m: Array,
    rotation: Array,
    position: Array,
    frame: Array,
    observation: Array,
    end_rays: Array,
    focal_px: float,
) -> Array:
    """(S,) the larger distance of the observed ends from the line's image, as angle times f.

    Args:
        end_rays: (M, 2, 3) unit rays of all observations' ends, camera frame.
        focal_px: focal length.

    The others are as in `joint_system`.
    """
    residual = np.empty(len(observation))
    y = np.empty(6)
    for line in range(len(v)):
        for row in range(offsets[line], offsets[line + 1]):
            k = observation[row]
            f = frame[k]
            seen_line(rotation[f], position[f], origin[line], v[line], m[line], y)
            norm = np.sqrt(y[3] * y[3] + y[4] * y[4] + y[5] * y[5])
            ray = end_rays[k]
            first = abs(ray[0, 0] * y[3] + ray[0, 1] * y[4] + ray[0, 2] * y[5])
            second = abs(ray[1, 0] * y[3] + ray[1, 1] * y[4] + ray[1, 2] * y[5])
            residual[row] = focal_px * max(first, second) / norm
    return residual


@numba.njit(cache=True, nogil=True, error_model="numpy")
def joint_cost(
    offsets: Array,
    origin: Array,
    v: Array,
    m: Array,
    rotation: Array,
    position: Array,
    frame: Array,
    observation: Array,
    forms: Array,
    weight: Array,
) -> Array:
    """(L,) the cost alone; arguments as in `joint_system`."""
    cost = np.zeros(len(v))
    y = np.empty(6)
    for line in range(len(v)):
        for row in range(offsets[line], offsets[line + 1]):
            if weight[row] == 0.0:
                continue
            k = observation[row]
            f = frame[k]
            seen_line(rotation[f], position[f], origin[line], v[line], m[line], y)
            cost[line] += weight[row] * quotient(forms[k], y)[0]
    return cost


@numba.njit(cache=True, nogil=True, error_model="numpy")
def joint_system(
    offsets: Array,
    origin: Array,
    v: Array,
    m: Array,
    jacobian: Array,
    rotation: Array,
    position: Array,
    by_tangent: Array,
    frame: Array,
    observation: Array,
    forms: Array,
    weight: Array,
) -> tuple[Array, Array, Array, Array, Array, Array]:
    """Cost, gradients and Gauss-Newton Hessians of sum w y_c^T G y_c / |m_c|^2.

    Args:
        offsets: (L + 1,) rows of each line.
        origin: (L, 3) m, world, about which `m` is taken.
        v, m: (L, 3).
        jacobian: (L, 6, 4) of (v, m) by the line's parameters.
        rotation, position: (N, 3, 3) and (N, 3) world from camera, of the frames.
        by_tangent: (N, 3, 3) how a pose turns when the rotation vector it is corrected by changes.
        frame: (M,) of all observations.
        observation: (S,) of each row.
        forms: (M, 6, 6) of all observations, camera frame.
        weight: (S,) of each row; rows of weight zero are passed over.

    Returns:
        (L,) cost; (L, 4) and (L, 4, 4) by line; (N, 6) and (N, 6, 6) by the tangents of the poses;
        (S, 4, 6) by the line and the tangent of each row.
    """
    line_count, frame_count = len(v), len(rotation)
    cost = np.zeros(line_count)
    by_line = np.zeros((line_count, 4))
    by_lines = np.zeros((line_count, 4, 4))
    by_pose = np.zeros((frame_count, 6))
    by_poses = np.zeros((frame_count, 6, 6))
    by_both = np.zeros((len(observation), 4, 6))
    y = np.empty(6)
    J, GJ = np.zeros((6, 10)), np.empty((6, 10))
    slope, block = np.empty(10), np.empty((10, 10))
    for line in range(line_count):
        for row in range(offsets[line], offsets[line + 1]):
            if weight[row] == 0.0:
                continue
            k = observation[row]
            f = frame[k]
            R = rotation[f]
            centre = seen_line(R, position[f], origin[line], v[line], m[line], y)
            row_jacobian(R, centre, v[line], m[line], jacobian[line], by_tangent[f], J)
            for i in range(6):
                for p in range(10):
                    value = 0.0
                    for j in range(6):
                        value += forms[k, i, j] * J[j, p]
                    GJ[i, p] = value
            ratio, squared = quotient(forms[k], y)
            cost[line] += weight[row] * ratio
            scale = weight[row] / squared
            for p in range(10):
                value = 0.0
                for i in range(6):
                    value += y[i] * GJ[i, p]
                # The quotient's own derivative: its denominator grows too.
                pull = y[3] * J[3, p] + y[4] * J[4, p] + y[5] * J[5, p]
                slope[p] = scale * (value - ratio * pull)
                for q in range(p, 10):
                    value = 0.0
                    for i in range(6):
                        value += J[i, p] * GJ[i, q]
                    block[p, q] = scale * value
                    block[q, p] = block[p, q]
            by_line[line] += slope[:4]
            by_lines[line] += block[:4, :4]
            by_pose[f] += slope[4:]
            by_poses[f] += block[4:, 4:]
            by_both[row] = block[:4, 4:]
    return cost, by_line, by_lines, by_pose, by_poses, by_both


@numba.njit(cache=True, nogil=True, error_model="numpy")
def focal_system(
    offsets: Array,
    origin: Array,
    v: Array,
    m: Array,
    jacobian: Array,
    rotation: Array,
    position: Array,
    by_tangent: Array,
    frame: Array,
    observation: Array,
    forms: Array,
    weight: Array,
) -> tuple[float, float, Array, Array]:
    """What the focal length adds to the normal equations; arguments as in `joint_system`.

    A ray (x/f, y/f, 1) meets the moment (a, b, c) as (x, y, 1) meets (a/f, b/f, c): where f grows
    by a share, a and b shrink by it.

    Returns:
        Gradient and Hessian by the share; Hessians by it and lines (L, 4), tangents (N, 6).
    """
    gradient, hessian = 0.0, 0.0
    by_line, by_pose = np.zeros((len(v), 4)), np.zeros((len(rotation), 6))
    y, J, pull = np.empty(6), np.zeros((6, 10)), np.empty(6)
    for line in range(len(v)):
        for row in range(offsets[line], offsets[line + 1]):
            if weight[row] == 0.0:
                continue
            k = observation[row]
            f = frame[k]
            centre = seen_line(rotation[f], position[f], origin[line], v[line], m[line], y)
            row_jacobian(rotation[f], centre, v[line], m[line], jacobian[line], by_tangent[f], J)
            ratio, squared = quotient(forms[k], y)
            scale = weight[row] / squared
            for i in range(6):
                pull[i] = -scale * (forms[k, i, 3] * y[3] + forms[k, i, 4] * y[4])
                gradient += y[i] * pull[i]
            gradient += scale * ratio * (y[3] * y[3] + y[4] * y[4])
            hessian -= pull[3] * y[3] + pull[4] * y[4]
            for i in range(6):
                for p in range(4):
                    by_line[line, p] += J[i, p] * pull[i]
                for p in range(6):
                    by_pose[f, p] += J[i, 4 + p] * pull[i]
    return gradient, hessian, by_line, by_pose


@numba.njit(cache=True, nogil=True, error_model="numpy")
def add_by_control(
    rows: Array,
    shares: Array,
    first: Array,
    blocks: Array,
    is_seen: Array,
) -> None:
    """Add a line's rows (n, 4, 6) to its `blocks` (4, 6 K) by the control points, and mark these.

    Args:
        rows: by the line and the tangent of each of its poses.
        shares: (n, D) of the control points that each tangent depends on.
        first: (n,) first of them.
        blocks, is_seen: (4, 6 K) and (K,), written to.
    """
    for row in range(len(rows)):
        for d in range(shares.shape[1]):
            control = first[row] + d
            is_seen[control] = True
            for p in range(4):
                for q in range(6):
                    blocks[p, 6 * control + q] += shares[row, d] * rows[row, p, q]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def runs_of(is_seen: Array, runs: Array) -> int:
    """Write half-open ranges of what is seen to `runs` (K, 2), and return how many there are."""
    count = 0
    for k in range(len(is_seen)):
        if not is_seen[k]:
            continue
        if count == 0 or runs[count - 1, 1] != k:
            runs[count, 0] = k
            count += 1
        runs[count - 1, 1] = k + 1
    return count


@numba.njit(cache=True, nogil=True, error_model="numpy")
def add_squares(solved: Array, runs: Array, taken: Array) -> None:
    """Add the upper triangle of solved^T solved, of (4, U) `solved`, to `taken` (U, U).

    All columns of `solved` outside the `runs` (n, 2) are taken for zero.
    """
    for run in range(len(runs)):
        for i in range(runs[run, 0], runs[run, 1]):
            for other in range(run, len(runs)):
                seen = slice(max(i, runs[other, 0]), runs[other, 1])
                add_combined(solved[:, i], solved[:, seen], taken[i, seen])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def add_combined(factors: Array, columns: Array, out: Array) -> None:
    """Add factors (4,) times columns (4, n) to `out` (n,)."""
    a, b, c, d = factors
    first, second, third, fourth = columns
    for k in range(len(out)):
        out[k] += a * first[k] + b * second[k] + c * third[k] + d * fourth[k]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def eliminated(
    offsets: Array,
    rows: Array,
    factor: Array,
    gradient: Array,
    first: Array,
    shares: Array,
    control_count: int,
) -> tuple[Array, Array]:
    """What lines take from the normal equations of the control points: B^T H^-1 B and B^T H^-1 g.

    B (4, 6 K) are a line's blocks by the control points. It is seen by few of them, in runs: that
    is where they are not zero.

    Args:
        offsets: (L + 1,) rows of each line.
        rows: (S, 4, 6) by the line and the tangent of each row.
        factor: (L, 4, 4) F with F^T F the inverse of each line's Hessian H.
        gradient: (L, 4) g, of each line.
        first: (S,) first of the control points that the tangent of a row depends on.
        shares: (S, D) of each of them.
        control_count: K.

    Returns:
        (6 K, 6 K), its upper triangle alone, and (6 K,).
    """
    size = 6 * control_count
    taken, pull = np.zeros((size, size)), np.zeros(size)
    blocks, solved = np.zeros((4, size)), np.zeros((4, size))
    is_seen = np.zeros(control_count, dtype=np.bool_)
    runs = np.empty((control_count, 2), dtype=np.int64)
    for line in range(len(offsets) - 1):
        own = slice(offsets[line], offsets[line + 1])
        add_by_control(rows[own], shares[own], first[own], blocks, is_seen)
        seen = 6 * runs[: runs_of(is_seen, runs)]
        g = factor[line] @ gradient[line]
        for start, stop in seen:
            for i in range(start, stop):
                for p in range(4):
                    solved[p, i] = 0.0
                    for q in range(4):
                        solved[p, i] += factor[line, p, q] * blocks[q, i]
                    pull[i] += solved[p, i] * g[p]
            blocks[:, start:stop] = 0.0
        add_squares(solved, seen, taken)
        is_seen[:] = False
    return taken, pull
