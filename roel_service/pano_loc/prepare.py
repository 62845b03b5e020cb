"""What the search looks up of a map: shared directions, places in free space, fields of distances.

Everything is laid out in the frame of the map's own directions, so that nothing depends on how the
map lies in the world.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from roel_service.arrays import Array, FloatArray, IntArray
from roel_service.config.stages import LocalizeConfig
from roel_service.geometry.segments import sample_segments
from roel_service.geometry.vectors import unit
from roel_service.pano_loc import fields_kernels
from roel_service.pano_loc.directions import class_of, principal_frame, shared_directions
from roel_service.scene.lines import LineMap

# Query directions: a grid on each side of a cube, that turns of the cube leave as it is.
RAYS_PER_SIDE = 10
# Fields are made of the longest lines.
FIELD_LINE_COUNT = 400
MAX_CHANNEL_COUNT = 6
# The places lie between these quantiles of the map's length in each direction, and so far inside.
BOX_QUANTILES = (0.03, 0.97)
BOX_MARGIN_M = 0.3
SAMPLE_SPACING_M = 0.05
MAX_PLACE_COUNT = 4000
# Shorter lines are more noise than line.
MIN_LINE_M = 0.05


# Grows with every change of what is prepared.
PREPARATION_VERSION = 1

Arrays = Mapping[str, Array]


@dataclass(frozen=True, eq=False, kw_only=True)
class PreparedMap:
    """A map with what does not depend on the picture.

    Attributes:
        segments: (L, 2, 3) m, longest first.
        directions: (L, 3) unit.
        channel: (L,) which shared direction a line has; -1 for none.
        shared: (D, 3) unit directions that many lines share, strongest first.
        frame: (3, 3) rotation whose rows are axes along shared directions.
        rays: (Q, 3) unit query directions, world.
        places: (T, 3) m, places that are tried.
        step_m: spacing of the places.
        fields: (T, Q, K) uint8 distances to lines of the K strongest classes.
    """

    segments: FloatArray
    directions: FloatArray
    channel: IntArray
    shared: FloatArray
    frame: FloatArray
    rays: FloatArray
    places: FloatArray
    step_m: float
    fields: Array

    def __len__(self) -> int:
        return len(self.segments)

    @property
    def channel_count(self) -> int:
        return min(len(self.shared), MAX_CHANNEL_COUNT)

    def to_arrays(self) -> Arrays:
        """For keeping it; under a name that `preparation_key` gives."""
        return {name: np.asarray(value) for name, value in vars(self).items()}

    @staticmethod
    def from_arrays(arrays: Arrays) -> PreparedMap:
        """The inverse."""
        values: dict[str, Any] = dict(arrays)
        return PreparedMap(**values | {"step_m": float(values["step_m"])})

    def fields_at(self, places: FloatArray) -> Array:
        """(T, Q, K) fields of other places."""
        return map_fields(self.segments, self.channel, self.channel_count, places, self.rays)


def preparation_key(map_digest: str, config: LocalizeConfig) -> str:
    """Names the preparation of a map: equal keys, equal arrays."""
    parameters = json.dumps(asdict(config), sort_keys=True)
    text = f"{map_digest} {PREPARATION_VERSION} {parameters}"
    return hashlib.sha256(text.encode()).hexdigest()


def prepare_map(line_map: LineMap, config: LocalizeConfig) -> PreparedMap:
    """Once for each map."""
    length_m = line_map.lengths_m
    order = np.argsort(-length_m, kind="stable")
    order = order[length_m[order] >= MIN_LINE_M]
    segments, length_m = line_map.segments[order], length_m[order]
    directions = unit(segments[:, 1] - segments[:, 0])
    shared = shared_directions(directions, length_m)
    channel = class_of(directions, shared[:MAX_CHANNEL_COUNT])
    frame = principal_frame(shared)
    rays = cube_rays(RAYS_PER_SIDE) @ frame
    places, step_m = free_places(segments, frame, config.grid_step_m)
    count = min(len(shared), MAX_CHANNEL_COUNT)
    return PreparedMap(
        segments=segments,
        directions=directions,
        channel=channel,
        shared=shared,
        frame=frame,
        rays=rays,
        places=places,
        step_m=step_m,
        fields=map_fields(segments, channel, count, places, rays),
    )


def map_fields(
    segments: FloatArray,
    channel: IntArray,
    channel_count: int,
    places: FloatArray,
    rays: FloatArray,
) -> Array:
    """(T, Q, K) fields of the longest lines."""
    chosen = np.flatnonzero(channel >= 0)[:FIELD_LINE_COUNT]
    return fields_kernels.map_fields(
        np.ascontiguousarray(segments[chosen]), channel[chosen], channel_count, places, rays
    )


def cube_rays(count: int) -> FloatArray:
    """(6 count^2, 3) unit rays at equal angles on each side of a cube."""
    tangent = np.tan(((np.arange(count) + 0.5) / count - 0.5) * np.pi / 2)
    a, b = (grid.ravel() for grid in np.meshgrid(tangent, tangent))
    side = np.stack([np.ones_like(a), a, b], axis=-1)
    sides = [sign * np.roll(side, axis, axis=1) for axis in range(3) for sign in (1.0, -1.0)]
    return unit(np.concatenate(sides))


def free_places(segments: FloatArray, frame: FloatArray, step_m: float) -> tuple[FloatArray, float]:
    """(T, 3) places inside the map's box, m, and their spacing, which is wider in large maps.

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
    step_m *= max(1.0, float((counts.prod() / MAX_PLACE_COUNT) ** (1 / 3)))
    # Centred, so that the signs of the axes do not matter.
    axes = [np.arange(-half, half + 0.5) for half in np.floor(2.0 * reach / step_m) / 2]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.ascontiguousarray((middle + step_m * grid) @ frame), step_m
