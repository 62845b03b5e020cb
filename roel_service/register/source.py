"""What is registered: points with a direction and a weight, sampled from lines or given as such."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roel_service.arrays import FloatArray, IntArray
from roel_service.errors import NoAnswerError
from roel_service.geometry.segments import sample_segments
from roel_service.geometry.vectors import norm, unit
from roel_service.scene.lines import LineMap

# Fewer lines leave a transform open whatever they are.
MIN_LINE_COUNT = 3
# Lines of more samples than this are sampled more sparsely: 1 km each 5 mm.
MAX_SAMPLE_COUNT = 200_000


@dataclass(frozen=True, eq=False, kw_only=True)
class Samples:
    """Points of the source.

    Attributes:
        points: (P, 3) m, source frame.
        directions: (P, 3) unit, of the line that each point is of; zero for points without one.
        group: (P,) which line; points of one line err together.
        sigma_m: (P,) standard deviation across the line; 0 where unknown.
        spacing_m: distance of neighbours on a line.
    """

    points: FloatArray
    directions: FloatArray
    group: IntArray
    sigma_m: FloatArray
    spacing_m: float

    def __len__(self) -> int:
        return len(self.points)

    @property
    def centre(self) -> FloatArray:
        """(3,) mean point, m."""
        return np.asarray(self.points.mean(axis=0))

    @property
    def radius_m(self) -> float:
        """Root of the mean squared distance from the centre."""
        return float(np.sqrt((norm(self.points - self.centre) ** 2).mean()))


def sample_map(line_map: LineMap, spacing_m: float, max_count: int = MAX_SAMPLE_COUNT) -> Samples:
    """Equally spaced points along all lines, both ends included, at most about `max_count`.

    Raises:
        NoAnswerError: fewer lines than `MIN_LINE_COUNT`.
    """
    if len(line_map) < MIN_LINE_COUNT:
        expected = f"at least {MIN_LINE_COUNT} lines"
        raise NoAnswerError("map", expected, f"{len(line_map)}", reason="TOO_FEW_LINES")
    room_for = max(max_count - 2 * len(line_map), 1)
    spacing_m = max(spacing_m, float(line_map.lengths_m.sum()) / room_for)
    points, line = sample_segments(line_map.segments, spacing_m)
    directions = np.nan_to_num(unit(line_map.segments[:, 1] - line_map.segments[:, 0]))
    return Samples(
        points=points,
        directions=directions[line],
        group=line,
        sigma_m=line_map.sigma_m.astype(np.float64)[line],
        spacing_m=spacing_m,
    )
