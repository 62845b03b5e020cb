"""A line map made ready to be followed: short pieces, so that a part that is hidden stands alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import connected_components

from roel_service.arrays import Array, FloatArray, IntArray, frozen_array
from roel_service.errors import NoAnswerError
from roel_service.geometry import segments
from roel_service.scene.lines import LineMap

# Pieces are this share of the map's extent at the longest.
PIECE_SHARE = 0.06
# Lines this close to each other in direction, and in distance as a share of the extent, are one edge.
EDGE_DEG, EDGE_SHARE = 2.0, 0.005
# Fewer lines do not hold six unknowns against chance.
MIN_LINE_COUNT = 6


@dataclass(frozen=True, eq=False, kw_only=True)
class MapPieces:
    """Pieces of the lines of a map.

    Attributes:
        segments: (P, 2, 3) m, world.
        direction: (P, 3) unit.
        edge: (P,) edge of the room that each piece is of: lines along one another are one edge,
            since who mistakes one for something else does so with all of them.
        extent_m: diagonal of the map's box.
    """

    segments: FloatArray
    direction: FloatArray
    edge: IntArray
    extent_m: float

    def __post_init__(self) -> None:
        pieces = frozen_array(self.segments, np.float64, (None, 2, 3), "segments")
        direction = frozen_array(self.direction, np.float64, (len(pieces), 3), "direction")
        edge = frozen_array(self.edge, np.int64, (len(pieces),), "edge")
        object.__setattr__(self, "segments", pieces)
        object.__setattr__(self, "edge", edge)
        object.__setattr__(self, "direction", direction)

    def __len__(self) -> int:
        return len(self.segments)


def pieces_of(line_map: LineMap) -> MapPieces:
    """Cut the lines of a map into pieces.

    Raises:
        NoAnswerError: TOO_FEW_LINES.
    """
    lines = line_map.segments[segments.length(line_map.segments) > 0.0]
    if len(lines) < MIN_LINE_COUNT:
        expected = f"at least {MIN_LINE_COUNT} lines to hold a pose"
        raise NoAnswerError("map", expected, f"{len(lines)}", reason="TOO_FEW_LINES")
    along, length_m = segments.span(lines), segments.length(lines)
    extent_m = float(np.linalg.norm(np.ptp(lines.reshape(-1, 3), axis=0)))
    line, begin, end = equal_parts(np.ceil(length_m / (PIECE_SHARE * extent_m)))
    shares = np.stack([begin, end], axis=1)[..., None]
    direction = along / length_m[:, None]
    edge = _edges(lines, direction, EDGE_SHARE * extent_m)
    return MapPieces(
        segments=lines[line, None, 0] + shares * along[line, None],
        direction=direction[line],
        edge=edge[line],
        extent_m=extent_m,
    )


def _edges(lines: FloatArray, direction: FloatArray, reach_m: float) -> IntArray:
    """(L,) edge of each line: lines of about one direction whose middles pass each other closely."""
    middle = segments.midpoint(lines)
    is_along = np.abs(direction @ direction.T) > np.cos(np.deg2rad(EDGE_DEG))
    across_m = np.linalg.norm(np.cross(middle[:, None] - middle[None], direction[None]), axis=-1)
    _, edge = connected_components(is_along & (across_m < reach_m), directed=True)
    return np.asarray(edge, np.int64)


def equal_parts(counts: Array) -> tuple[IntArray, FloatArray, FloatArray]:
    """Segments cut into (L,) equal parts each: of every part, the segment, and its begin and end.

    Begin and end are shares of the segment, 0 to 1.
    """
    counts = counts.astype(np.int64)
    owner = np.repeat(np.arange(len(counts)), counts)
    place = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    return owner, place / counts[owner], (place + 1) / counts[owner]
