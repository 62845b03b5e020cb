"""The lines of a map file as messages: those that meet some conditions, block by block."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from roel_service.arrays import Array, BoolArray, FloatArray
from roel_service.errors import InputError
from roel_service.geometry.segments import reaches_box
from roel_service.scene.lines import LineMap
from roel_service.v1 import maps_pb2
from roel_service.wire.nouns import bounds_from_proto
from roel_service.wire.rlm import MapBlocks


@dataclass(frozen=True, eq=False, kw_only=True)
class Conditions:
    """What a line must meet.

    Attributes:
        lower_m, upper_m: (3,) corners of a box that it must reach into; infinite for any line.
    """

    lower_m: FloatArray
    upper_m: FloatArray
    min_length_m: float
    min_observation_count: int

    def met_by(self, lines: LineMap) -> BoolArray:
        """(L,) which lines do."""
        inside = reaches_box(lines.segments, self.lower_m, self.upper_m)
        long = lines.lengths_m >= self.min_length_m
        return inside & long & (lines.observation_count >= self.min_observation_count)

    def may_be_met_between(self, lower_m: FloatArray, upper_m: FloatArray) -> bool:
        """Whether lines within another box can reach into this one."""
        return bool((lower_m <= self.upper_m).all() and (self.lower_m <= upper_m).all())


def conditions_from_proto(request: maps_pb2.GetLinesRequest) -> Conditions:
    """Raises `InputError` for a box or a bound that cannot be."""
    lower, upper = np.full(3, -np.inf), np.full(3, np.inf)
    if request.HasField("bounds"):
        lower, upper = bounds_from_proto(request.bounds)
        if not (np.isfinite([lower, upper]).all() and (lower <= upper).all()):
            found = f"{lower.tolist()} and {upper.tolist()}"
            raise InputError("bounds", "finite corners, the lower one first", found)
    if not (math.isfinite(request.min_length_m) and request.min_length_m >= 0):
        expected = "a finite length of at least 0"
        raise InputError("min_length_m", expected, f"{request.min_length_m}")
    return Conditions(
        lower_m=lower,
        upper_m=upper,
        min_length_m=request.min_length_m,
        min_observation_count=request.min_observation_count,
    )


def line_messages(
    blocks: MapBlocks, conditions: Conditions, map_version: str, max_line_count: int
) -> Iterator[maps_pb2.GetLinesResponse]:
    """Messages of at most so many lines; at least one, also without any line."""
    waiting = _Columns.of(LineMap.from_segments(np.empty((0, 2, 3))), np.empty(0, np.bool_))
    for block in range(blocks.count):
        if not conditions.may_be_met_between(*blocks.bounds_m(block)):
            continue
        lines = blocks.lines(block)
        waiting = waiting.followed_by(_Columns.of(lines, conditions.met_by(lines)))
        while len(waiting) > max_line_count:
            yield waiting.rows(slice(max_line_count)).message(map_version)
            waiting = waiting.rows(slice(max_line_count, None))
    yield waiting.message(map_version)


@dataclass(frozen=True, eq=False)
class _Columns:
    """Lines as the columns of a message, in the order of its fields."""

    values: tuple[Array, ...]

    @staticmethod
    def of(lines: LineMap, rows: BoolArray) -> _Columns:
        columns = (lines.segments, lines.observation_count, lines.rms_residual_px, lines.sigma_m)
        return _Columns(tuple(column[rows] for column in columns))

    def __len__(self) -> int:
        return len(self.values[0])

    def rows(self, rows: slice) -> _Columns:
        return _Columns(tuple(column[rows] for column in self.values))

    def followed_by(self, other: _Columns) -> _Columns:
        pairs = zip(self.values, other.values, strict=True)
        return _Columns(tuple(np.concatenate(pair) for pair in pairs))

    def message(self, map_version: str) -> maps_pb2.GetLinesResponse:
        segments, counts, residuals, sigmas = self.values
        return maps_pb2.GetLinesResponse(
            map_version=map_version,
            segments_m=segments.astype("<f8").tobytes(),
            observation_count=counts.astype("<i4").tobytes(),
            rms_residual_px=residuals.astype("<f4").tobytes(),
            sigma_m=sigmas.astype("<f4").tobytes(),
        )
