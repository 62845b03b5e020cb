"""Sums over pairs of a sample and what pulls it: normal equations as one Gram matrix.

A pair is a row (J, off): how the distance along a normal changes with a rotation about the pivot, a
shift, and growth, and that distance itself. The (8, 8) sum of weighted outer products of rows holds the
Hessian, the gradient and the sum of squares.
"""

from __future__ import annotations

import numba
import numpy as np

from roel_service.arrays import FloatArray, IntArray

# What a row stands for: three of rotation, three of shift, one of growth, and the distance.
ROW_SIZE = 8
# A crease less long than this across has no other axis to take for a normal.
_SAFE_COMPONENT = 0.6


@numba.njit(cache=True, nogil=True)
def surface_sums(
    moved: FloatArray,
    weights: FloatArray,
    rows: IntArray,
    points: FloatArray,
    normals: FloatArray,
    scale_m: float,
    point_share: float,
    pivot: FloatArray,
) -> tuple[FloatArray, float]:
    """Samples pulled along the normals of surfaces.

    Args:
        moved: (P, 3) m; weights: (P,).
        rows: (P,) the surface point that each sample is paired with; -1 for none.
        points, normals: (S, 3) of the surfaces.
        scale_m: of the robust loss.
        point_share: share of each pair that pulls along the surface as well; then the whole
            distance counts in the loss, since far along a surface is far as well.
        pivot: (3,) m.

    Returns:
        (8, 8) upper triangle of the sum, and the sum of the weights.
    """
    gram = np.zeros((ROW_SIZE, ROW_SIZE))
    row = np.empty(ROW_SIZE)
    total = 0.0
    for i in range(len(moved)):
        j = rows[i]
        if j < 0:
            continue
        ox = moved[i, 0] - points[j, 0]
        oy = moved[i, 1] - points[j, 1]
        oz = moved[i, 2] - points[j, 2]
        nx, ny, nz = normals[j, 0], normals[j, 1], normals[j, 2]
        off = ox * nx + oy * ny + oz * nz
        size2 = ox * ox + oy * oy + oz * oz if point_share > 0.0 else off * off
        weight = weights[i] * _geman_mcclure(size2, scale_m)
        ax, ay, az = moved[i, 0] - pivot[0], moved[i, 1] - pivot[1], moved[i, 2] - pivot[2]
        _add(gram, row, ax, ay, az, nx, ny, nz, off, weight)
        total += weight
        if point_share > 0.0:
            share = point_share * weight
            _add(gram, row, ax, ay, az, 1.0, 0.0, 0.0, ox, share)
            _add(gram, row, ax, ay, az, 0.0, 1.0, 0.0, oy, share)
            _add(gram, row, ax, ay, az, 0.0, 0.0, 1.0, oz, share)
            total += 3.0 * share
    return gram, total


@numba.njit(cache=True, nogil=True)
def crease_sums(
    moved: FloatArray,
    weights: FloatArray,
    rows: IntArray,
    points: FloatArray,
    directions: FloatArray,
    scale_m: float,
    pivot: FloatArray,
) -> tuple[FloatArray, float]:
    """Samples pulled across creases, from both sides; arguments as for `surface_sums`."""
    gram = np.zeros((ROW_SIZE, ROW_SIZE))
    row = np.empty(ROW_SIZE)
    total = 0.0
    for i in range(len(moved)):
        j = rows[i]
        if j < 0:
            continue
        ux, uy, uz = directions[j, 0], directions[j, 1], directions[j, 2]
        ox = moved[i, 0] - points[j, 0]
        oy = moved[i, 1] - points[j, 1]
        oz = moved[i, 2] - points[j, 2]
        along = ox * ux + oy * uy + oz * uz
        ox, oy, oz = ox - along * ux, oy - along * uy, oz - along * uz
        weight = weights[i] * _geman_mcclure(ox * ox + oy * oy + oz * oz, scale_m)
        # Any normal of the crease, and the one that is normal to both.
        if abs(ux) < _SAFE_COMPONENT:
            nx, ny, nz = 0.0, uz, -uy
        else:
            nx, ny, nz = -uz, 0.0, ux
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        nx, ny, nz = nx / length, ny / length, nz / length
        mx, my, mz = uy * nz - uz * ny, uz * nx - ux * nz, ux * ny - uy * nx
        ax, ay, az = moved[i, 0] - pivot[0], moved[i, 1] - pivot[1], moved[i, 2] - pivot[2]
        _add(gram, row, ax, ay, az, nx, ny, nz, ox * nx + oy * ny + oz * nz, weight)
        _add(gram, row, ax, ay, az, mx, my, mz, ox * mx + oy * my + oz * mz, weight)
        total += 2.0 * weight
    return gram, total


@numba.njit(cache=True, nogil=True)
def _geman_mcclure(distance2_m2: float, scale_m: float) -> float:
    """A weight that falls to a quarter at the scale, and with the fourth power beyond."""
    share = scale_m * scale_m / (scale_m * scale_m + distance2_m2)
    return share * share


@numba.njit(cache=True, nogil=True)
def _add(
    gram: FloatArray,
    row: FloatArray,
    ax: float,
    ay: float,
    az: float,
    nx: float,
    ny: float,
    nz: float,
    off: float,
    weight: float,
) -> None:
    """Add a pair at an arm from the pivot; `row` is scratch, the sum is kept in place for speed."""
    row[0], row[1], row[2] = ay * nz - az * ny, az * nx - ax * nz, ax * ny - ay * nx
    row[3], row[4], row[5] = nx, ny, nz
    row[6] = ax * nx + ay * ny + az * nz
    row[7] = off
    for a in range(ROW_SIZE):
        scaled = weight * row[a]
        for b in range(a, ROW_SIZE):
            gram[a, b] += scaled * row[b]
