"""Votes for a few shifts, counted one by one where a correlation of whole grids would be too much."""

from __future__ import annotations

import numba
import numpy as np

from roel_service.arrays import Array, FloatArray, IntArray


@numba.njit(cache=True, nogil=True)
def count_votes(
    presence: Array, cells: IntArray, channel: IntArray, shifts: IntArray, is_cyclic: bool
) -> FloatArray:
    """(S,) votes of all samples for each shift.

    Args:
        presence: (K + 1, X, Y, Z) float32; of each direction's channel, and of the surfaces last.
        cells: (P, 3) where the samples are before the shift.
        channel: (P,) direction of each sample; -1 for none.
        shifts: (S, 3) cells.
        is_cyclic: whether what leaves the grid comes in on the other side; else it has no votes.
    """
    surfaces = presence.shape[0] - 1
    nx, ny, nz = presence.shape[1], presence.shape[2], presence.shape[3]
    votes = np.zeros(len(shifts))
    for s in range(len(shifts)):
        total = 0.0
        for p in range(len(cells)):
            x = cells[p, 0] + shifts[s, 0]
            y = cells[p, 1] + shifts[s, 1]
            z = cells[p, 2] + shifts[s, 2]
            if is_cyclic:
                x, y, z = x % nx, y % ny, z % nz
            elif not (0 <= x < nx and 0 <= y < ny and 0 <= z < nz):
                continue
            total += presence[surfaces, x, y, z]
            if channel[p] >= 0:
                total += presence[channel[p], x, y, z]
        votes[s] = total
    return votes
