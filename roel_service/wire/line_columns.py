"""Lines as the integer columns of a map file, and back.

Ends are rounded to a grid, ordered along a Morton curve and stored as differences; quality is
stored as the logarithm, 16 codes to the octave.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from roel_service.arrays import Array, BoolArray, FloatArray, IntArray
from roel_service.errors import MapFileError
from roel_service.scene.lines import LineMap
from roel_service.wire.byte_planes import integers_from_planes, planes_from_integers

# 1 mm where the extent allows it: coordinates fit COORDINATE_BITS and resolve 1/8192 of the map.
PREFERRED_STEP_M = 1e-3
COORDINATE_BITS = 21
MAX_STEPS = 2**COORDINATE_BITS - 1
MIN_STEPS_PER_EXTENT = 2**13

# What code 1 of the quality columns stands for; code 0 is "unknown".
SMALLEST_RMS_PX = 1e-2
SMALLEST_SIGMA_M = 1e-4
CODES_PER_OCTAVE = 16

# Bytes of a value of each column by id: start, dx, dy, dz, observation count, rms, sigma.
COLUMN_BYTES = {1: 8, 2: 4, 3: 4, 4: 4, 5: 2, 6: 1, 7: 1}
GEOMETRY_COLUMNS = (1, 2, 3, 4)


class DamageError(ValueError):
    """What is wrong with the bytes of a map file; who decodes adds which file it is."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Grid:
    """Rounding of coordinates: position = origin + step q, 0 <= q <= `MAX_STEPS`.

    Attributes:
        origin: (3,) m, lower corner of the map.
        step: m.
    """

    origin: FloatArray
    step: float

    @staticmethod
    def around(lower: FloatArray, upper: FloatArray) -> Grid:
        """The grid of a map between two corners, (3,) m each.

        Raises:
            MapFileError: the corners are farther apart than float64 can say.
        """
        with np.errstate(over="ignore"):
            extent = float((upper - lower).max())
        if not math.isfinite(extent):
            raise MapFileError("map", "an extent that float64 holds", "a larger one")
        step = min(PREFERRED_STEP_M, extent / MIN_STEPS_PER_EXTENT)
        step = max(step, extent / MAX_STEPS)
        # A map without extent has no line that survives rounding, whatever the step.
        return Grid(origin=lower, step=step or PREFERRED_STEP_M)

    def steps(self, points: FloatArray) -> IntArray:
        """(*B, 3) int64 nearest grid points."""
        # The clip undoes the last bit of rounding at the far end of the largest maps.
        return np.rint(np.clip((points - self.origin) / self.step, 0, MAX_STEPS)).astype(np.int64)

    def points(self, steps: IntArray) -> FloatArray:
        """(*B, 3) m."""
        return np.asarray(self.origin + self.step * steps)


@dataclass(frozen=True, eq=False, kw_only=True)
class RoundedLines:
    """Lines on the grid, undirected no more: a start comes first on the Morton curve.

    Attributes:
        start, end: (L, 3) int64 steps.
        observation_count: (L,) uint16, saturated.
        rms_code, sigma_code: (L,) uint8, see `quality_from_code`.
    """

    start: IntArray
    end: IntArray
    observation_count: Array
    rms_code: Array
    sigma_code: Array

    def __len__(self) -> int:
        return len(self.start)

    def __getitem__(self, rows: slice | IntArray | BoolArray) -> RoundedLines:
        return RoundedLines(
            start=self.start[rows],
            end=self.end[rows],
            observation_count=self.observation_count[rows],
            rms_code=self.rms_code[rows],
            sigma_code=self.sigma_code[rows],
        )


def round_lines(line_map: LineMap, grid: Grid) -> RoundedLines:
    """Round to the grid, drop lines whose ends coincide, and sort along the Morton curve."""
    ends = grid.steps(line_map.segments)
    codes = morton_code(ends)
    swapped = codes[:, 1] < codes[:, 0]
    ends[swapped] = ends[swapped][:, ::-1]
    lines = RoundedLines(
        start=ends[:, 0],
        end=ends[:, 1],
        observation_count=np.clip(line_map.observation_count, 0, 2**16 - 1).astype(np.uint16),
        rms_code=code_from_quality(line_map.rms_residual_px, SMALLEST_RMS_PX),
        sigma_code=code_from_quality(line_map.sigma_m, SMALLEST_SIGMA_M),
    )
    lines = lines[codes[:, 0] != codes[:, 1]]
    dx, dy, dz = (lines.end - lines.start).T
    # Quality decides between equal segments, so that the order never depends on the input's.
    keys = (lines.sigma_code, lines.rms_code, lines.observation_count, dz, dy, dx)
    return lines[np.lexsort((*keys, morton_code(lines.start)))]


def line_map_from_rounded(lines: RoundedLines, grid: Grid) -> LineMap:
    """The map that is at most half a step per axis off the one before rounding."""
    return LineMap(
        segments=grid.points(np.stack([lines.start, lines.end], axis=1)),
        observation_count=lines.observation_count.astype(np.int32),
        rms_residual_px=quality_from_code(lines.rms_code, SMALLEST_RMS_PX),
        sigma_m=quality_from_code(lines.sigma_code, SMALLEST_SIGMA_M),
    )


def columns_from_lines(lines: RoundedLines) -> dict[int, bytes]:
    """The raw columns of a block of sorted lines, by id."""
    codes = morton_code(lines.start)
    delta = lines.end - lines.start
    zigzag = np.where(delta < 0, -2 * delta - 1, 2 * delta)
    values = (
        np.diff(codes, prepend=np.uint64(0)),
        *zigzag.T,
        lines.observation_count,
        lines.rms_code,
        lines.sigma_code,
    )
    return {
        column: planes_from_integers(value, COLUMN_BYTES[column])
        for column, value in zip(COLUMN_BYTES, values, strict=True)
    }


def lines_from_columns(columns: dict[int, bytes], count: int) -> RoundedLines:
    """A block of lines from raw columns of checked lengths; a missing quality is unknown.

    Raises:
        DamageError: values that no map gives.
    """
    unknown = {column: bytes(count * size) for column, size in COLUMN_BYTES.items()}
    code_steps, dx, dy, dz, observation_count, rms_code, sigma_code = (
        integers_from_planes(np.frombuffer(data, np.uint8), COLUMN_BYTES[column])
        for column, data in (unknown | columns).items()
    )
    codes = np.cumsum(code_steps)
    # A sum that wraps around decreases.
    if (codes[1:] < codes[:-1]).any() or codes[-1] >= 2 ** (3 * COORDINATE_BITS):
        raise DamageError("starts outside the grid")
    zigzag = np.stack([dx, dy, dz], axis=1).astype(np.int64)
    start = steps_from_morton(codes)
    end = start + np.where(zigzag & 1, -(zigzag + 1) // 2, zigzag // 2)
    if not (0 <= end.min() <= end.max() <= MAX_STEPS) or (start == end).all(axis=1).any():
        raise DamageError("ends outside the grid")
    return RoundedLines(
        start=start,
        end=end,
        observation_count=observation_count,
        rms_code=rms_code,
        sigma_code=sigma_code,
    )


def morton_code(steps: IntArray) -> Array:
    """(*B,) uint64 of (*B, 3) steps: bit b of x, y, z becomes bit 3b, 3b + 1, 3b + 2."""
    code: Array = np.zeros(steps.shape[:-1], np.uint64)
    for bit in range(COORDINATE_BITS):
        for axis in range(3):
            code |= ((steps[..., axis] >> bit & 1) << 3 * bit + axis).astype(np.uint64)
    return code


def steps_from_morton(code: Array) -> IntArray:
    """(*B, 3) int64 of (*B,) codes below 2^63."""
    signed = code.astype(np.int64)
    steps = np.zeros((*code.shape, 3), np.int64)
    for bit in range(COORDINATE_BITS):
        for axis in range(3):
            steps[..., axis] |= (signed >> 3 * bit + axis & 1) << bit
    return steps


def code_from_quality(values: Array, smallest: float) -> Array:
    """(L,) uint8 nearest codes of non-negative values; 0 stays 0, all else is 1 to 255."""
    known = values > 0
    octaves = np.log2(np.where(known, values, smallest) / smallest)
    codes = np.clip(np.rint(1 + CODES_PER_OCTAVE * octaves), 1, 255)
    return np.where(known, codes, 0).astype(np.uint8)


def quality_from_code(codes: Array, smallest: float) -> Array:
    """(L,) float32; 0 where unknown."""
    values = smallest * np.exp2((codes.astype(np.float64) - 1) / CODES_PER_OCTAVE)
    return np.where(codes > 0, values, 0.0).astype(np.float32)
