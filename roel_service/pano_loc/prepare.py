"""What the search looks up of a map: shared directions, places in free space, views from them.

Everything is laid out in the frame of the map's own directions, so that nothing depends on how the
map lies in the world.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from roel_service.arrays import Array, FloatArray
from roel_service.config.stages import LocalizeConfig
from roel_service.geometry.segments import sample_segments
from roel_service.geometry.vectors import unit
from roel_service.pano_loc.directions import class_of, principal_frame, shared_directions
from roel_service.pano_loc.views import (
    ClassedLines,
    Views,
    class_frames,
    classed_lines,
    views_from,
)
from roel_service.scene.lines import LineMap

MAX_CHANNEL_COUNT = 6
# Views at all places: of the lines that are widest from there, in so many bearings.
VIEW_LINE_COUNT, BEARING_COUNT = 400, 180
# All places are tried with the widest of them first.
OUTLINE_LINE_COUNT = 100
# The places lie between these quantiles of the map's length in each direction, and so far inside.
BOX_QUANTILES = (0.02, 0.98)
BOX_MARGIN_M = 0.2
SAMPLE_SPACING_M = 0.05
# The grid is wider in large maps, and finer in small ones.
MIN_PLACE_COUNT, MAX_PLACE_COUNT = 400, 12000
# Shorter lines are more noise than line.
MIN_LINE_M = 0.05


Arrays = Mapping[str, Array]


@dataclass(frozen=True, eq=False, kw_only=True)
class PreparedMap:
    """A map with what does not depend on the picture.

    Attributes:
        segments: (L, 2, 3) m, longest first.
        shared: (D, 3) unit directions that many lines share, strongest first.
        frame: (3, 3) rotation whose rows are axes along shared directions.
        places: (T, 3) m, places that are tried.
        step_m: spacing of the places.
        lines: those that have a class.
        outline, views: what few and what many of these look like from the places.
    """

    segments: FloatArray
    shared: FloatArray
    frame: FloatArray
    places: FloatArray
    step_m: float
    lines: ClassedLines
    outline: Views
    views: Views

    def __len__(self) -> int:
        return len(self.segments)

    @property
    def size_bytes(self) -> int:
        """Of memory."""
        return sum(array.nbytes for array in self.to_arrays().values())

    def to_arrays(self) -> Arrays:
        """For keeping it."""
        plain = {name: value for name, value in vars(self).items() if name not in _PARTS}
        parts = {
            f"{name}_{key}": value
            for name in _PARTS
            for key, value in vars(getattr(self, name)).items()
        }
        return {name: np.asarray(value) for name, value in (plain | parts).items()}

    @staticmethod
    def from_arrays(arrays: Arrays) -> PreparedMap:
        """The inverse."""
        values: dict[str, Any] = {
            name: value.item() if value.ndim == 0 else value for name, value in arrays.items()
        }
        for name, kind in _PARTS.items():
            part = {key.name: values.pop(f"{name}_{key.name}") for key in fields(kind)}
            values[name] = kind(**part)
        return PreparedMap(**values)


_PARTS: dict[str, Any] = {"lines": ClassedLines, "outline": Views, "views": Views}


def prepare_map(line_map: LineMap, config: LocalizeConfig) -> PreparedMap:
    """Once for each map."""
    length_m = line_map.lengths_m
    order = np.argsort(-length_m, kind="stable")
    order = order[length_m[order] >= MIN_LINE_M]
    segments, length_m = line_map.segments[order], length_m[order]
    directions = unit(segments[:, 1] - segments[:, 0])
    shared = shared_directions(directions, length_m)
    channel = class_of(directions, shared[:MAX_CHANNEL_COUNT])
    frame = principal_frame(shared, directions)
    lines = classed_lines(segments, channel, class_frames(shared[:MAX_CHANNEL_COUNT], frame))
    places, step_m = free_places(segments, frame, config.grid_step_m)
    return PreparedMap(
        segments=segments,
        shared=shared,
        frame=frame,
        places=places,
        step_m=step_m,
        lines=lines,
        outline=views_from(lines, places, BEARING_COUNT, OUTLINE_LINE_COUNT),
        views=views_from(lines, places, BEARING_COUNT, VIEW_LINE_COUNT),
    )


def free_places(segments: FloatArray, frame: FloatArray, step_m: float) -> tuple[FloatArray, float]:
    """(T, 3) places inside the map's box, m, and their spacing.

    Args:
        segments: (L, 2, 3) m.
        frame: (3, 3), rows are the axes of the box.
        step_m: spacing.
    """
    points, _ = sample_segments(segments @ frame.T, SAMPLE_SPACING_M)
    if len(points) == 0:
        return np.empty((0, 3)), step_m
    low, high = np.quantile(points, BOX_QUANTILES, axis=0)
    middle, reach = (low + high) / 2, np.maximum((high - low) / 2 - BOX_MARGIN_M, 0.0)
    counts = 2.0 * reach / step_m + 1.0
    count = counts.prod()
    step_m *= float((count / np.clip(count, MIN_PLACE_COUNT, MAX_PLACE_COUNT)) ** (1 / 3))
    # Centred, so that the signs of the axes do not matter.
    axes = [np.arange(-half, half + 0.5) for half in np.floor(2.0 * reach / step_m) / 2]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.ascontiguousarray((middle + step_m * grid) @ frame), step_m
