"""Places whose maps are registered: rooms, many of them side by side, and rooms that half a turn leaves alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from roel_bench.catalogue import TUNING_SEEDS
from roel_service.arrays import FloatArray
from roel_service.geometry.se3 import SE3
from roel_service.scene.clouds import PointCloud, TriangleMesh
from roel_service.scene.lines import LineMap

ROOM, LARGE, SYMMETRIC, MAP = "room", "large", "symmetric", "map"

# Parameters were chosen by looking at these.
TUNING_PLACES = ("room_11", "room_12", *(f"sim_{seed}" for seed in TUNING_SEEDS))

# What the times of the issue are asked for.
LARGE_LINE_COUNT, LARGE_POINT_COUNT = 2500, 400_000
LARGE_GAP_M = 0.3

SYMMETRIC_SEED = 501
SYMMETRIC_PAIR_COUNT = 6
SYMMETRIC_POINT_COUNT, SYMMETRIC_NOISE_M = 150_000, 0.005


@dataclass(frozen=True, eq=False, kw_only=True)
class Place:
    """A map, and a cloud or another map of the same place, in one frame: the true transform is the identity.

    Attributes:
        kind: `room`, `large`, `symmetric`, or `map` where the target is a map.
        symmetry: a motion that leaves the place as it is, if there is one.
    """

    name: str
    line_map: LineMap
    target: PointCloud | LineMap
    kind: str = ROOM
    is_tuning: bool = False
    symmetry: SE3 | None = None

    @property
    def points(self) -> FloatArray:
        """(N, 3) of the target, m: of the cloud, or the ends of the lines."""
        if isinstance(self.target, LineMap):
            return self.target.segments.reshape(-1, 3)
        return self.target.points.astype(np.float64)


def place_of(name: str, line_map: LineMap, target_name: str, target: PointCloud | LineMap) -> Place:
    """A room by the names of its map and of what the map is laid over."""
    is_tuning = name in TUNING_PLACES
    if isinstance(target, PointCloud):
        return Place(name=name, line_map=line_map, target=target, is_tuning=is_tuning)
    name = f"{name} on {target_name}"
    return Place(name=name, line_map=line_map, target=target, kind=MAP, is_tuning=is_tuning)


def side_by_side(places: Sequence[Place]) -> Place:
    """Rooms in a row of rows as one large place, cut to the lines and points that times are asked for.

    Every room keeps its own map and its own cloud; nothing joins them but where they stand. Lines
    beyond the count are left out room by room alike, and points by chance. Maps on maps are passed over.
    """
    places = [place for place in places if place.kind == ROOM]
    column_count = int(np.ceil(np.sqrt(len(places))))
    extents = [np.ptp(place.points, axis=0) for place in places]
    pitch_m = np.max(extents, axis=0) + LARGE_GAP_M
    maps, clouds = [], []
    for index, place in enumerate(places):
        row, column = divmod(index, column_count)
        corner = place.points.min(axis=0)
        shift = np.array([column, row, 0.0]) * pitch_m - corner
        T = SE3(rotation=np.eye(3), translation=shift)
        maps.append(place.line_map.transformed(T))
        clouds.append(T @ place.points)
    rng = np.random.default_rng(0)
    points = np.concatenate(clouds)
    points = rng.permutation(points)[:LARGE_POINT_COUNT]
    return Place(
        name=f"{len(places)} rooms side by side",
        line_map=_joined(maps, LARGE_LINE_COUNT),
        target=PointCloud(points=points),
        kind=LARGE,
        is_tuning=any(place.is_tuning for place in places),
    )


def _joined(maps: Sequence[LineMap], count: int) -> LineMap:
    """At most so many lines of all maps, spread evenly over them."""
    fields = ("segments", "observation_count", "rms_residual_px", "sigma_m")
    columns = {
        name: np.concatenate([getattr(line_map, name) for line_map in maps]) for name in fields
    }
    total = len(columns["segments"])
    kept = np.unique(np.linspace(0, total - 1, min(count, total)).round().astype(np.int64))
    return LineMap(**{name: column[kept] for name, column in columns.items()})


def part_of(cloud: PointCloud, share: float) -> PointCloud:
    """A share of the points, cut off across the longer side."""
    axis = int(np.argmax(np.ptp(cloud.points, axis=0)))
    along = cloud.points[:, axis]
    return PointCloud(points=cloud.points[along <= np.quantile(along, share)])


def symmetric_rooms(count: int) -> list[Place]:
    """Rooms of boxes in pairs, each at half a turn about the room's middle from the other."""
    return [_symmetric_room(SYMMETRIC_SEED + index) for index in range(count)]


def _symmetric_room(seed: int) -> Place:
    rng = np.random.default_rng(seed)
    size = np.array([rng.uniform(4.2, 6.5), rng.uniform(3.2, 4.8), rng.uniform(2.4, 2.9)])
    boxes = [np.array([-0.5, 0.5])[:, None] * size]
    for _ in range(SYMMETRIC_PAIR_COUNT):
        extent = rng.uniform([0.3, 0.3, 0.4], [1.4, 1.4, 1.8])
        low = rng.uniform(-0.5 * size, 0.5 * size - extent)
        box = np.stack([low, low + extent])
        boxes += [box, box * [-1.0, -1.0, 1.0]]
    mesh = TriangleMesh(triangles=np.concatenate([_triangles(box) for box in boxes]))
    points = mesh.sampled(SYMMETRIC_POINT_COUNT, rng).points
    segments = np.concatenate([_edges(box) for box in boxes])
    # The ends of lines that events see fall short of the corners.
    cut = rng.uniform(0.0, 0.15, (len(segments), 2, 1)) * [[[1.0], [-1.0]]]
    segments = segments + cut * (segments[:, 1] - segments[:, 0])[:, None]
    return Place(
        name=f"symmetric_{seed}",
        line_map=LineMap.from_segments(
            segments + rng.normal(0.0, SYMMETRIC_NOISE_M, segments.shape)
        ),
        target=PointCloud(points=points + rng.normal(0.0, SYMMETRIC_NOISE_M, points.shape)),
        kind=SYMMETRIC,
        symmetry=SE3(rotation=np.diag([-1.0, -1.0, 1.0]), translation=np.zeros(3)),
    )


_BITS = np.array([[index >> 2 & 1, index >> 1 & 1, index & 1] for index in range(8)])
_SIDES = [(a, a | 1 << bit) for a in range(8) for bit in range(3) if not a >> bit & 1]
_FACES = [(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5)]


def _corners(box: FloatArray) -> FloatArray:
    """(8, 3) of a box between two opposite corners (2, 3) in any order."""
    return np.asarray(box[0] + _BITS * (box[1] - box[0]))


def _edges(box: FloatArray) -> FloatArray:
    """(12, 2, 3) m."""
    return np.asarray(_corners(box)[np.array(_SIDES)])


def _triangles(box: FloatArray) -> FloatArray:
    """(12, 3, 3) m."""
    p = _corners(box)
    return np.concatenate([[p[[a, b, c]], p[[a, c, d]]] for a, b, c, d in _FACES])
