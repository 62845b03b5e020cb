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
def turned_cross(R: Array, a: Array, out: Array) -> None:
    """Write R^T [a]x to `out` (3, 3)."""
    for i in range(3):
        out[i, 0] = R[1, i] * a[2] - R[2, i] * a[1]
        out[i, 1] = R[2, i] * a[0] - R[0, i] * a[2]
        out[i, 2] = R[0, i] * a[1] - R[1, i] * a[0]


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
            cx = position[f, 0] - origin[line, 0]
            cy = position[f, 1] - origin[line, 1]
            cz = position[f, 2] - origin[line, 2]
            into_camera(rotation[f], cx, cy, cz, v[line], m[line], y)
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
            cx = position[f, 0] - origin[line, 0]
            cy = position[f, 1] - origin[line, 1]
            cz = position[f, 2] - origin[line, 2]
            into_camera(rotation[f], cx, cy, cz, v[line], m[line], y)
            squared = y[3] * y[3] + y[4] * y[4] + y[5] * y[5]
            value = 0.0
            for i in range(6):
                for j in range(6):
                    value += y[i] * forms[k, i, j] * y[j]
            cost[line] += weight[row] * value / squared
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
        frame: (M,) of all observations.
        observation: (S,) of each row.
        forms: (M, 6, 6) of all observations, camera frame.
        weight: (S,) of each row; rows of weight zero are passed over.

    Returns:
        (L,) cost; (L, 4) and (L, 4, 4) by line; (N, 6) and (N, 6, 6) by pose; (S, 4, 6) by the line
        and the pose of each row.
    """
    line_count, frame_count = len(v), len(rotation)
    cost = np.zeros(line_count)
    by_line = np.zeros((line_count, 4))
    by_lines = np.zeros((line_count, 4, 4))
    by_pose = np.zeros((frame_count, 6))
    by_poses = np.zeros((frame_count, 6, 6))
    by_both = np.zeros((len(observation), 4, 6))
    y, column, seen = np.empty(6), np.empty(6), np.empty(3)
    J, GJ = np.zeros((6, 10)), np.empty((6, 10))
    slope, block = np.empty(10), np.empty((10, 10))
    for line in range(line_count):
        for row in range(offsets[line], offsets[line + 1]):
            if weight[row] == 0.0:
                continue
            k = observation[row]
            f = frame[k]
            R = rotation[f]
            cx = position[f, 0] - origin[line, 0]
            cy = position[f, 1] - origin[line, 1]
            cz = position[f, 2] - origin[line, 2]
            into_camera(R, cx, cy, cz, v[line], m[line], y)
            for p in range(4):
                into_camera(R, cx, cy, cz, jacobian[line, :3, p], jacobian[line, 3:, p], column)
                J[:, p] = column
            seen[0] = m[line, 0] - (cy * v[line, 2] - cz * v[line, 1])
            seen[1] = m[line, 1] - (cz * v[line, 0] - cx * v[line, 2])
            seen[2] = m[line, 2] - (cx * v[line, 1] - cy * v[line, 0])
            turned_cross(R, v[line], J[:3, 4:7])
            turned_cross(R, seen, J[3:, 4:7])
            J[3:, 7:] = J[:3, 4:7]
            for i in range(6):
                for p in range(10):
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
            cost[line] += weight[row] * quotient
            scale = weight[row] / squared
            for p in range(10):
                value = 0.0
                for i in range(6):
                    value += y[i] * GJ[i, p]
                # The quotient's own derivative: its denominator grows too.
                pull = y[3] * J[3, p] + y[4] * J[4, p] + y[5] * J[5, p]
                slope[p] = scale * (value - quotient * pull)
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
def by_control(
    offsets: Array,
    frame: Array,
    observation: Array,
    by_both: Array,
    first_control: Array,
    basis: Array,
    control_count: int,
    first_line: int,
    last_line: int,
) -> Array:
    """(l, 4, 6 K) blocks of some lines by the control points that the poses follow.

    Args:
        offsets, frame, observation, by_both: as in `joint_system`.
        first_control: (N,) first of the control points that a frame depends on.
        basis: (N, D) share of each of them.
        control_count: K.
        first_line, last_line: half-open range of the lines.
    """
    blocks = np.zeros((last_line - first_line, 4, 6 * control_count))
    for line in range(first_line, last_line):
        for row in range(offsets[line], offsets[line + 1]):
            f = frame[observation[row]]
            for d in range(basis.shape[1]):
                start = 6 * (first_control[f] + d)
                for p in range(4):
                    for q in range(6):
                        blocks[line - first_line, p, start + q] += basis[f, d] * by_both[row, p, q]
    return blocks
