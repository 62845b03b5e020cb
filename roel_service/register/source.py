"""What is registered: points with a direction and a weight, sampled from lines or given as such."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roel_service.arrays import FloatArray, IntArray
from roel_service.errors import NoAnswerError
from roel_service.geometry.segments import sample_segments
from roel_service.geometry.vectors import norm, unit
from roel_service.register.directions import dominant_directions
from roel_service.register.prepare import PreparedCloud
from roel_service.scene.lines import LineMap

# Fewer lines leave a transform open whatever they are.
MIN_LINE_COUNT = 3
# Samples of the finest level; more lines are sampled more sparsely.
SAMPLE_COUNT = 6000
# Samples closer together would only repeat one another.
MIN_SPACING_M = 0.01
# Error across a line that its own uncertainty does not tell, m.
FLOOR_SIGMA_M = 0.03


@dataclass(frozen=True, eq=False, kw_only=True)
class Samples:
    """Points of the source, in its frame.

    Attributes:
        points: (P, 3) m.
        directions: (P, 3) unit, of the line that each point is of; zero for points without one.
        weights: (P,) mean 1, by the uncertainty of the lines.
        group: (P,) which line; points of one line err together.
    """

    points: FloatArray
    directions: FloatArray
    weights: FloatArray
    group: IntArray

    def __len__(self) -> int:
        return len(self.points)

    def every(self, stride: int) -> Samples:
        """Each so many of them."""
        return Samples(
            points=self.points[::stride],
            directions=self.directions[::stride],
            weights=self.weights[::stride],
            group=self.group[::stride],
        )

    def at_most(self, count: int) -> Samples:
        """About so many of them, evenly spread."""
        return self.every(-(-len(self) // count))

    def scaled(self, scale: float) -> Samples:
        return Samples(
            points=scale * self.points,
            directions=self.directions,
            weights=self.weights,
            group=self.group,
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Source:
    """One side of a registration.

    Attributes:
        samples: of all that lies on surfaces.
        votes: of all that lies on creases; the lines themselves, if it is a line map.
        axes: (K, 3) directions that many lines share.
    """

    samples: Samples
    votes: Samples
    axes: FloatArray

    @property
    def centre(self) -> FloatArray:
        """(3,) mean sample, m."""
        return np.asarray(self.samples.points.mean(axis=0))

    @property
    def size_m(self) -> float:
        """Diagonal of the box about the bulk: a few wild lines make any box large."""
        low, high = np.percentile(self.samples.points, [2.0, 98.0], axis=0)
        return float(np.linalg.norm(high - low))


def require_lines(line_map: LineMap) -> None:
    """Raise `NoAnswerError` for a map of fewer lines than `MIN_LINE_COUNT`."""
    if len(line_map) < MIN_LINE_COUNT:
        expected = f"at least {MIN_LINE_COUNT} lines"
        raise NoAnswerError("map", expected, f"{len(line_map)}", reason="TOO_FEW_LINES")


def source_of_map(line_map: LineMap) -> Source:
    """Equally spaced points along all lines.

    Raises:
        NoAnswerError: fewer lines than `MIN_LINE_COUNT`.
    """
    require_lines(line_map)
    # The order of the lines must not matter, not even for which of them are sampled coarsely.
    order = np.lexsort(line_map.segments.mean(axis=1).T)
    segments, sigma_m = line_map.segments[order], line_map.sigma_m[order].astype(np.float64)
    lengths_m = norm(segments[:, 1] - segments[:, 0])
    spacing_m = max(MIN_SPACING_M, float(lengths_m.sum()) / SAMPLE_COUNT)
    points, line = sample_segments(segments, spacing_m)
    directions = np.nan_to_num(unit(segments[:, 1] - segments[:, 0]))
    weights = 1.0 / (FLOOR_SIGMA_M**2 + sigma_m[line] ** 2)
    samples = Samples(
        points=points,
        directions=directions[line],
        weights=weights / weights.mean(),
        group=line,
    )
    has_length = lengths_m > 0.0
    axes = dominant_directions(directions[has_length], lengths_m[has_length])
    return Source(samples=samples, votes=samples, axes=axes)


def source_of_cloud(cloud: PreparedCloud) -> Source:
    """The points of a cloud, and its creases for lines."""
    return Source(
        samples=_plain_samples(cloud.points, np.zeros_like(cloud.points)).at_most(SAMPLE_COUNT),
        votes=_plain_samples(cloud.creases.points, cloud.creases.directions),
        axes=cloud.axes,
    )


def _plain_samples(points: FloatArray, directions: FloatArray) -> Samples:
    return Samples(
        points=points,
        directions=directions,
        weights=np.ones(len(points)),
        group=np.arange(len(points)),
    )
