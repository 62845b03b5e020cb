"""Where lines of different principal directions meet, in a picture and in a map.

Pair k is that of the directions k and k + 1, counted round.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roel_service.arrays import Array, FloatArray, IntArray
from roel_service.geometry.vectors import dot, norm, unit
from roel_service.pano_loc.arcs import PanoramaArcs

# An intersection may lie this far beyond the ends of an arc, both ends together.
MAX_BEYOND_RAD = 0.1
# Or this far from either of two segments, and they from each other.
MAX_DISTANCE_M = 0.2


@dataclass(frozen=True, eq=False, kw_only=True)
class Intersections:
    """Points where two lines meet.

    Attributes:
        points: (N, 3) unit rays, or m.
        pair: (N,) 0 to 2.
        lines: (N, 2) indices of the two lines, that of direction k first.
    """

    points: FloatArray
    pair: IntArray
    lines: IntArray

    def __len__(self) -> int:
        return len(self.pair)

    def relabelled(self, pair: Array) -> Intersections:
        """The same with pair k called pair[k]."""
        return Intersections(points=self.points, pair=pair[self.pair], lines=self.lines)


def _collected(parts: list[tuple[int, FloatArray, Array]]) -> Intersections:
    return Intersections(
        points=np.concatenate([np.empty((0, 3)), *(points for _, points, _ in parts)]),
        pair=np.repeat([k for k, _, _ in parts], [len(points) for _, points, _ in parts]),
        lines=np.concatenate([np.empty((0, 2), np.int64), *(lines for _, _, lines in parts)]),
    )


def intersections_of_arcs(arcs: PanoramaArcs, channel: IntArray) -> Intersections:
    """Where arcs of different classes cross; a circle's other crossing counts as well.

    Args:
        channel: (A,) class of each arc; -1 for none.
    """
    middles = unit(arcs.starts + arcs.ends)
    # On one circle, both ends together are as far beyond as twice the way from the nearer one.
    min_cosine = np.cos((arcs.length_rad + MAX_BEYOND_RAD) / 2)
    parts = []
    for k in range(3):
        i, j = _pairs(channel, k)
        crossing = unit(np.cross(arcs.normals[i], arcs.normals[j]))
        cosine_i, cosine_j = dot(crossing, middles[i]), dot(crossing, middles[j])
        for sign in (1.0, -1.0):
            both = (sign * cosine_i > min_cosine[i]) & (sign * cosine_j > min_cosine[j])
            parts.append((k, sign * crossing[both], np.stack([i[both], j[both]], axis=1)))
    return _collected(parts)


def _pairs(channel: IntArray, k: int) -> tuple[IntArray, IntArray]:
    """Indices of all pairs of lines of the directions k and k + 1."""
    i, j = np.meshgrid(
        np.flatnonzero(channel == k), np.flatnonzero(channel == (k + 1) % 3), indexing="ij"
    )
    return i.ravel(), j.ravel()


def intersections_of_lines(segments: FloatArray, channel: IntArray) -> Intersections:
    """Where segments of different classes nearly meet, on the first of the two.

    Args:
        segments: (L, 2, 3) m.
        channel: (L,) class of each; -1 for none.
    """
    parts = []
    for k in range(3):
        i, j = _pairs(channel, k)
        first, second = segments[i, 1] - segments[i, 0], segments[j, 1] - segments[j, 0]
        across = np.cross(first, second)
        squared = np.maximum(dot(across, across), 1e-12)
        between = segments[j, 0] - segments[i, 0]
        along_first = dot(np.cross(between, second), across) / squared
        along_second = dot(np.cross(between, first), across) / squared
        points = segments[i, 0] + along_first[:, None] * first
        gap_m = norm(points - segments[j, 0] - along_second[:, None] * second)
        near = (
            _is_along(along_first, norm(first))
            & _is_along(along_second, norm(second))
            & (gap_m < MAX_DISTANCE_M)
        )
        parts.append((k, points[near], np.stack([i[near], j[near]], axis=1)))
    return _collected(parts)


def _is_along(share: FloatArray, length_m: FloatArray) -> Array:
    """Whether points at shares of segments lie on them, or not far beyond."""
    beyond = MAX_DISTANCE_M / length_m
    return np.asarray((share > -beyond) & (share < 1.0 + beyond))


def without_gaps(found: Intersections, channel: IntArray) -> Intersections:
    """Pairs after one whose lines are missing move up, as the released code has it."""
    present = [bool(len(_pairs(channel, k)[0])) for k in range(3)]
    return found.relabelled(np.cumsum([0, *present[:2]]))
