"""Where a turned map may lie: all shifts are scored at once, by correlation on a grid.

Lines vote for creases of the cloud that run their way, and less so for surfaces. The best shifts are
then looked at again on a finer grid, which the correlation would take too long on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft, ndimage

from roel_service.arrays import Array, BoolArray, FloatArray, IntArray
from roel_service.register.surfaces import Creases
from roel_service.register.voting_kernels import count_votes

# Lines and creases this near to a direction (cosine) vote in its channel.
CHANNEL_COSINE = 0.93
# What a surface near a sample counts against a crease.
SURFACE_WEIGHT = 0.3
# The grid is made coarser until both clouds fit into so many cells.
MAX_CELL_COUNT = 1 << 20
# The fine grid's cells in one of the coarse grid's, and how many of its cells a shift may move.
FINE_CELLS, FINE_REACH = 3, 3
MAX_FINE_CELL_COUNT = 1 << 22
# Few shifts are counted sample by sample; beyond so many look-ups a correlation is faster.
MAX_COUNTED = 6_000_000
# Samples that are looked at on the fine grid.
FINE_SAMPLE_COUNT = 300


@dataclass(frozen=True, eq=False, kw_only=True)
class VotingGrid:
    """The target's side of the correlation, transformed once.

    Attributes:
        axes: (K, 3) directions of the channels.
        origin: (3,) m, corner of the grid.
        cell_m: size of a cell.
        shape: cells of the grid along each axis, the source's share included.
        coarse: (K + 1, *shape) presence in each direction's channel, and of surfaces last.
        spectra: of the coarse channels.
        source_size_m: largest extent that a source may have in any direction.
        fine: (K + 1, *F) the same on the fine grid.
        fine_cell_m: size of its cells.
    """

    axes: FloatArray
    origin: FloatArray
    cell_m: float
    shape: tuple[int, ...]
    coarse: Array
    spectra: list[Array]
    source_size_m: float
    fine: Array
    fine_cell_m: float

    @property
    def size_bytes(self) -> int:
        """Of memory."""
        return sum(array.nbytes for array in (self.coarse, self.fine, *self.spectra))


@dataclass(frozen=True, eq=False, kw_only=True)
class Votes:
    """Scores of shifts: `scores[i]` is of a shift by `shifts[i]`, best first.

    Attributes:
        shifts: (V, 3) m.
        scores: (V,) votes a sample.
    """

    shifts: FloatArray
    scores: FloatArray


def voting_grid(
    surfaces: FloatArray,
    creases: Creases,
    axes: FloatArray,
    source_size_m: float,
    cell_m: float,
) -> VotingGrid:
    """Prepare a target for votes.

    Args:
        surfaces: (N, 3) m.
        creases: of the target.
        axes: (K, 3) directions of the channels.
        source_size_m: largest extent that the source can have in any direction.
        cell_m: wanted size of a cell.
    """
    origin = surfaces.min(axis=0)
    extent_m = np.ptp(surfaces, axis=0)
    size_m = extent_m + source_size_m
    cell_m = max(cell_m, float(np.cbrt(size_m.prod() / MAX_CELL_COUNT)))
    shape = tuple(fft.next_fast_len(int(n), real=True) for n in np.ceil(size_m / cell_m) + 4)
    fine_cell_m = max(
        cell_m / FINE_CELLS, float(np.cbrt((extent_m + cell_m).prod() / MAX_FINE_CELL_COUNT))
    )
    fine_shape = tuple(int(n) for n in np.ceil(extent_m / fine_cell_m) + 3)
    channel = channels_of(creases.directions, axes)
    members = [creases.points[channel == k] for k in range(len(axes))] + [surfaces]
    weights = [1.0] * len(axes) + [SURFACE_WEIGHT]
    coarse, fine = [], []
    for points, weight in zip(members, weights, strict=True):
        coarse.append(weight * _presence(points, origin, cell_m, shape))
        corner = origin - fine_cell_m
        fine.append(weight * _presence(points, corner, fine_cell_m, fine_shape))
    return VotingGrid(
        axes=axes,
        origin=origin,
        cell_m=cell_m,
        shape=shape,
        coarse=np.stack(coarse),
        spectra=[_spectrum(channel) for channel in coarse],
        source_size_m=source_size_m,
        fine=np.stack(fine),
        fine_cell_m=fine_cell_m,
    )


def sharpened(
    grid: VotingGrid, points: FloatArray, directions: FloatArray, shift: FloatArray
) -> FloatArray:
    """(3,) the shift near a coarse one that has the most votes on the fine grid.

    Args:
        grid: of the target.
        points, directions: (P, 3) turned samples of the source.
        shift: (3,) m.
    """
    stride = -(-len(points) // FINE_SAMPLE_COUNT)
    points, directions = points[::stride], directions[::stride]
    steps = np.arange(-FINE_REACH, FINE_REACH + 1)
    offsets = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    corner = grid.origin - grid.fine_cell_m
    cells = np.rint((points + shift - corner) / grid.fine_cell_m).astype(np.int64)
    channel = channels_of(directions, grid.axes)
    scores = count_votes(grid.fine, cells, channel, offsets, False)
    # Of equal ones the nearest to the coarse shift.
    best = np.lexsort((np.abs(offsets).sum(axis=1), -scores))[0]
    return np.asarray(shift + offsets[best] * grid.fine_cell_m)


def channels_of(directions: FloatArray, axes: FloatArray) -> IntArray:
    """(N,) the axis that each direction is near to; -1 for none."""
    if len(axes) == 0:
        return np.full(len(directions), -1)
    cosines = np.abs(directions @ axes.T)
    return np.where(cosines.max(axis=1) > CHANNEL_COSINE, cosines.argmax(axis=1), -1)


def vote(
    grid: VotingGrid,
    points: FloatArray,
    directions: FloatArray,
    count: int,
    allowed: FloatArray | None = None,
    reach_m: float = 0.0,
) -> Votes:
    """The shifts that bring the most samples onto creases of their direction, or surfaces.

    Args:
        grid: of the target.
        points, directions: (P, 3) turned samples of the source.
        count: of shifts to answer, at most.
        allowed: (A, 3) m; only shifts within `reach_m` of one of these, along each axis.
    """
    corner = points.min(axis=0)
    # Wild lines that the grid does not hold vote somewhere in it; they are few.
    cells = np.rint((points - corner) / grid.cell_m).astype(np.int64) % np.array(grid.shape)
    channel = channels_of(directions, grid.axes)
    # Cells of the source start at `corner`: a shift by i cells puts it at origin + i cells.
    offset = grid.origin - corner
    inside = None if allowed is None else _within(grid, offset, allowed, reach_m)
    if inside is not None and np.count_nonzero(inside) * len(points) < MAX_COUNTED:
        scores = _counted(grid, cells, channel, inside)
    else:
        scores = _correlated(grid, cells, channel)
        if inside is not None:
            scores[~inside] = -np.inf
    return _peaks(grid, scores / len(points), offset, count)


def _counted(grid: VotingGrid, cells: IntArray, channel: IntArray, inside: BoolArray) -> Array:
    """Votes for the shifts inside a part of the grid, minus infinity elsewhere."""
    scores = np.full(grid.shape, -np.inf, np.float32)
    scores[inside] = count_votes(grid.coarse, cells, channel, np.argwhere(inside), True)
    return scores


def _correlated(grid: VotingGrid, cells: IntArray, channel: IntArray) -> Array:
    """Votes for all shifts of the grid."""
    total = np.zeros((*grid.shape[:2], grid.shape[2] // 2 + 1), np.complex64)
    for k, spectrum in enumerate(grid.spectra):
        chosen = cells if k == len(grid.axes) else cells[channel == k]
        if len(chosen):
            votes = np.zeros(grid.shape, np.float32)
            np.add.at(votes, tuple(chosen.T), 1.0)
            total += spectrum * np.conj(_spectrum(votes))
    return np.asarray(fft.irfftn(total, grid.shape, workers=2))


def _within(grid: VotingGrid, offset: FloatArray, allowed: FloatArray, reach_m: float) -> BoolArray:
    """Which shifts of the grid lie in a cube about one of the allowed ones."""
    inside = np.zeros(grid.shape, np.bool_)
    steps = [np.arange(n) for n in grid.shape]
    for place in allowed:
        axes = []
        for k, step in enumerate(steps):
            # Shifts to below the origin have wrapped around to the far end.
            shift = np.where(step > grid.shape[k] // 2, step - grid.shape[k], step)
            near_low = np.abs(offset[k] + step * grid.cell_m - place[k]) <= reach_m
            near_wrapped = np.abs(offset[k] + shift * grid.cell_m - place[k]) <= reach_m
            axes.append(near_low | near_wrapped)
        inside |= axes[0][:, None, None] & axes[1][:, None] & axes[2]
    return inside


def _peaks(grid: VotingGrid, scores: Array, offset: FloatArray, count: int) -> Votes:
    """The best shifts, none next to another."""
    shape = np.array(grid.shape)
    cells, values = [], []
    for _ in range(count):
        best = np.array(np.unravel_index(np.argmax(scores), grid.shape))
        value = scores[tuple(best)]
        if not np.isfinite(value):
            break
        cells.append(best)
        values.append(float(value))
        around = [(best[k] + np.arange(-2, 3)) % shape[k] for k in range(3)]
        scores[np.ix_(*around)] = -np.inf
    # A source that reaches out of the target on the low side has wrapped around.
    found = np.array(cells).reshape(-1, 3)
    found = np.where(found > WRAP_SHARE * shape, found - shape, found)
    return Votes(shifts=offset + found * grid.cell_m, scores=np.array(values))


# Shifts beyond this share of the grid are taken for wrapped, negative ones.
WRAP_SHARE = 0.66


def _presence(
    points: FloatArray, origin: FloatArray, cell_m: float, shape: tuple[int, ...]
) -> Array:
    """Cells with points, blurred by a cell, at most one."""
    grid = np.zeros(shape, np.float32)
    cells = np.rint((points - origin) / cell_m).astype(np.int64)
    grid[tuple(cells.T)] = 1.0
    if len(points) == 0:
        return grid
    blurred = ndimage.gaussian_filter(grid, 0.7, mode="constant")
    return np.asarray(blurred / max(float(blurred.max()), 1e-9))


def _spectrum(grid: Array) -> Array:
    return np.asarray(fft.rfftn(grid, workers=2))
