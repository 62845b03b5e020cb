"""Robust least squares of one pose over matches of arcs with lines.

Steps are (r, d) in the picture's frame: R <- R Exp(r), t <- t + R d.
"""

from __future__ import annotations

import numba
import numpy as np

from roel_service.arrays import FloatArray, IntArray
from roel_service.pano_loc.sight_kernels import Samples, Sight, dot, match_rays, near, see

# Rays that are off by more widths of the kernel do not count.
CUTOFF_WIDTHS = 3.0
# A step goes no farther; beyond it the residuals are not linear.
MAX_SHIFT_M = 0.3
MAX_TURN_RAD = np.deg2rad(8.0)
DAMPING = 1e-3
# Steps smaller than this, rad and m, are the last one.
CONVERGED = 1e-4


@numba.njit(cache=True, nogil=True)
def widest(segments: FloatArray, place: FloatArray, count: int) -> FloatArray:
    """Those of (L, 2, 3) segments that take up most of the view from a (3,) place, m."""
    if count >= len(segments):
        return segments
    size = np.empty(len(segments))
    for j in range(len(segments)):
        square, length_square, along = 0.0, 0.0, 0.0
        for axis in range(3):
            span = segments[j, 1, axis] - segments[j, 0, axis]
            offset = segments[j, 0, axis] + 0.5 * span - place[axis]
            square += offset * offset
            length_square += span * span
            along += span * offset
        across_square = max(0.0, length_square * square - along * along)
        size[j] = np.sqrt(across_square) / max(square, 1e-12)
    least = np.partition(size, len(size) - count)[len(size) - count]
    return np.asarray(segments[size >= least])


@numba.njit(cache=True, nogil=True)
def refined(
    segments: FloatArray,
    rotation: FloatArray,
    place: FloatArray,
    samples: Samples,
    widths_rad: FloatArray,
    max_angle_rad: float,
    slack_rad: float,
    crowd_angle_rad: float,
    crowd_reach_rad: float,
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """A pose after Gauss-Newton steps with kernels of these widths.

    Args:
        segments: (L, 2, 3) m, world.
        rotation, place: (3, 3) R_world_picture and (3,) m, to begin with.
        samples: of the arcs.
        widths_rad: (N,) of the kernel, in each iteration.
        max_angle_rad: between arcs and lines.
        slack_rad: lines are looked for near arcs once, with so much to spare.
        crowd_angle_rad, crowd_reach_rad: lines with this angle to an arc, and this close to a ray,
            are its crowd.

    Returns:
        Rotation and place; (S,) sine of the angle of each ray to the nearest line, infinite without
        one; (S,) its crowd.
    """
    sight = see(segments, rotation, place)
    pairs = near(sight, samples, crowd_angle_rad, CUTOFF_WIDTHS * widths_rad[0], slack_rad)
    for width_rad in widths_rad:
        line, residual, _ = match_rays(
            sight, samples, pairs, max_angle_rad, CUTOFF_WIDTHS * width_rad
        )
        H, g = normal_equations(sight, samples, line, residual, width_rad)
        step = _damped_step(H, g.sum(axis=0))
        place = place + rotation @ step[3:]
        rotation = rotation @ _rotation(step[:3])
        sight = see(segments, rotation, place)
        if width_rad == widths_rad[-1] and np.sqrt((step**2).sum()) < CONVERGED:
            break
    line, residual, crowd = match_rays(sight, samples, pairs, crowd_angle_rad, crowd_reach_rad)
    off = np.where(line >= 0, np.abs(residual), np.inf)
    return rotation, place, off, crowd


@numba.njit(cache=True, nogil=True)
def normal_equations(
    sight: Sight, samples: Samples, line: IntArray, residual: FloatArray, width_rad: float
) -> tuple[FloatArray, FloatArray]:
    """(6, 6) Gauss-Newton sum of Geman-McClure weighted residuals, and (L, 6) gradient by line.

    The residual of a ray y is y . N, N the unit normal of the plane of centre and line; its
    derivative is linear in the ray, so that rays of one arc on one line are summed up first.

    Args:
        sight: the lines.
        samples: the arcs.
        line: (S,) that each ray lies on, -1 for none.
        residual: (S,) of each.
        width_rad: of the kernel.
    """
    H, g = np.zeros((6, 6)), np.zeros((len(sight.normals), 6))
    ahead, beside = np.empty(6), np.empty(6)
    for a in range(len(samples.normals)):
        s, last = samples.offsets[a], samples.offsets[a + 1]
        while s < last:
            j = line[s]
            cc, ct, tt, rc, rt = 0.0, 0.0, 0.0, 0.0, 0.0
            while s < last and line[s] == j:
                if j >= 0 and abs(residual[s]) <= CUTOFF_WIDTHS * width_rad:
                    c, t = samples.cosine[s], samples.sine[s]
                    robust = samples.weight[s] / (1.0 + (residual[s] / width_rad) ** 2) ** 2
                    cc, ct, tt = cc + robust * c * c, ct + robust * c * t, tt + robust * t * t
                    rc, rt = rc + robust * residual[s] * c, rt + robust * residual[s] * t
                s += 1
            if cc + tt == 0.0:
                continue
            jacobian(
                samples.middles[a], sight.spans[j], sight.normals[j], sight.moments_m2[j], ahead
            )
            jacobian(
                samples.asides[a], sight.spans[j], sight.normals[j], sight.moments_m2[j], beside
            )
            for p in range(6):
                g[j, p] += rc * ahead[p] + rt * beside[p]
                first = cc * ahead[p] + ct * beside[p]
                second = ct * ahead[p] + tt * beside[p]
                for q in range(p, 6):
                    H[p, q] += first * ahead[q] + second * beside[q]
    for p in range(6):
        for q in range(p):
            H[p, q] = H[q, p]
    return H, g


@numba.njit(cache=True, nogil=True)
def jacobian(
    ray: FloatArray, span: FloatArray, normal: FloatArray, moment_m2: float, out: FloatArray
) -> None:
    """Derivative of ray . N by the turn and the shift of the pose, into `out` (6,).

    Args:
        ray: (3,).
        span: (3,) start - end of the line, m.
        normal: (3,) N, along start x end.
        moment_m2: length of that.
        out: the result.
    """
    along = dot(ray, normal)
    x, y, z = ray[0] - along * normal[0], ray[1] - along * normal[1], ray[2] - along * normal[2]
    out[0] = ray[1] * normal[2] - ray[2] * normal[1]
    out[1] = ray[2] * normal[0] - ray[0] * normal[2]
    out[2] = ray[0] * normal[1] - ray[1] * normal[0]
    out[3] = (span[1] * z - span[2] * y) / moment_m2
    out[4] = (span[2] * x - span[0] * z) / moment_m2
    out[5] = (span[0] * y - span[1] * x) / moment_m2


@numba.njit(cache=True, nogil=True)
def _damped_step(H: FloatArray, g: FloatArray) -> FloatArray:
    """(6,) shortened to what stays linear."""
    damped = H.copy()
    for p in range(6):
        damped[p, p] += DAMPING * max(H[p, p], 1e-9)
    step = -np.linalg.solve(damped, g)
    turn_rad, shift_m = np.sqrt((step[:3] ** 2).sum()), np.sqrt((step[3:] ** 2).sum())
    return np.asarray(step / max(1.0, turn_rad / MAX_TURN_RAD, shift_m / MAX_SHIFT_M))


@numba.njit(cache=True, nogil=True)
def _rotation(vector: FloatArray) -> FloatArray:
    """(3, 3) Exp of a (3,) vector, rad, by Rodrigues' formula."""
    angle = max(np.sqrt((vector**2).sum()), 1e-12)
    x, y, z = vector / angle
    axis = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turn = np.eye(3) + np.sin(angle) * axis + (1.0 - np.cos(angle)) * (axis @ axis)
    return np.asarray(turn)
