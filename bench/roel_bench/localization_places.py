"""Places whose maps panoramas are located in: rooms, a photographed house, symmetric rooms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from roel_bench.registration_places import TUNING_PLACES
from roel_service.arrays import Array, FloatArray
from roel_service.errors import InputError
from roel_service.geometry.se3 import SE3
from roel_service.io.files import read_input
from roel_service.io.images import read_panorama
from roel_service.scene.lines import LineMap
from roel_service.simulate import textures
from roel_service.simulate.panoramas import render_panorama
from roel_service.simulate.rooms import BOX_FACES, SceneBuilder
from roel_service.simulate.scenes import Scene, texture_atlas

# What a place is: a room whose map is built from events; rooms of a house, or all of it, with the
# lines of its layout and photographs; a room that half a turn leaves as it is.
ROOM, HOUSE_ROOM, HOUSE, HOUSE_OUTSIDE, SYMMETRIC = (
    "room",
    "house room",
    "house",
    "house outside",
    "symmetric",
)
MAX_POSES_BYTES = 1 << 20
# Mapped from events of a photograph; looked at, too.
REAL_ROOM = "events_room01"
# Ends the name of a room whose map's lines were cut in pieces, to have a map of many lines.
IN_PIECES = "_in_pieces"

SYMMETRIC_SEED = 401
SYMMETRIC_PANORAMA_COUNT = 4
SYMMETRIC_WIDTH_PX = 1024
SYMMETRIC_PAIR_COUNT = 6
SYMMETRIC_NOISE_M = 0.01
SYMMETRIC_PIECE_COUNT = 3
# Panoramas are taken so far from the walls and from the furniture along them.
SYMMETRIC_REACH = 0.25


@dataclass(frozen=True, eq=False, kw_only=True)
class Panorama:
    """A picture and where it was taken.

    Attributes:
        name: within its place.
        T_world_panorama: truth.
        read: (H, 2H) uint8 grey values.
    """

    name: str
    T_world_panorama: SE3
    read: Callable[[], Array]


@dataclass(frozen=True, eq=False, kw_only=True)
class Place:
    """A map and panoramas of the same place, in one frame."""

    name: str
    kind: str
    line_map: LineMap
    panoramas: tuple[Panorama, ...]
    is_tuning: bool = False

    def moved(self, T_b_a: SE3) -> Place:
        """The same place in another frame."""
        panoramas = tuple(
            replace(item, T_world_panorama=T_b_a @ item.T_world_panorama) for item in self.panoramas
        )
        return replace(self, line_map=self.line_map.transformed(T_b_a), panoramas=panoramas)


def room(name: str, line_map: LineMap, folder: Path) -> Place:
    """A map of a room and a folder of panoramas as `roel simulate` writes it."""
    panoramas = tuple(panorama for _, panorama in _panoramas(folder))
    is_tuning = name.removesuffix(IN_PIECES) in (*TUNING_PLACES, REAL_ROOM)
    return Place(name=name, kind=ROOM, line_map=line_map, panoramas=panoramas, is_tuning=is_tuning)


def house(lines: Path, folder: Path) -> list[Place]:
    """The whole house, what was taken outside its rooms, and its rooms one by one.

    Args:
        lines: archive of `segments` (L, 2, 3) m and `room` (L,) names.
        folder: panoramas, with the name of the room at the end of each line of their poses.

    Raises:
        InputError: files that cannot be used.
    """
    try:
        with np.load(lines, allow_pickle=False) as archive:
            segments, line_room = np.asarray(archive["segments"], np.float64), archive["room"]
    except (OSError, ValueError, KeyError) as error:
        raise InputError(str(lines), "arrays segments and room", str(error)) from error
    named = _panoramas(folder)
    inside = [(name, item) for name, item in named if name in line_room]
    outside = [(name, item) for name, item in named if name not in line_room]

    def place(name: str, kind: str, lines: Array, items: list[tuple[str, Panorama]]) -> Place:
        panoramas = tuple(item for _, item in items)
        line_map = LineMap.from_segments(lines)
        return Place(name=name, kind=kind, line_map=line_map, panoramas=panoramas)

    rooms = [
        place(name, HOUSE_ROOM, segments[line_room == name], [p for p in inside if p[0] == name])
        for name in sorted({name for name, _ in inside})
    ]
    whole = place("house", HOUSE, segments, inside)
    return [whole, place("house, outside its lines", HOUSE_OUTSIDE, segments, outside), *rooms]


def _panoramas(folder: Path) -> list[tuple[str, Panorama]]:
    """Panoramas, each with the name of its room, which may be empty."""
    path = folder / "poses.txt"
    found = []
    for line in read_input(path, MAX_POSES_BYTES).decode("utf-8", "replace").splitlines():
        if not line.strip() or line.startswith("#"):
            continue
        words = line.split()
        try:
            number, values = int(words[0]), np.array(words[1:8], np.float64)
            pose = SE3.from_quaternion(values[3:], values[:3])
        except (ValueError, IndexError) as error:
            raise InputError(str(path), "index tx ty tz qx qy qz qw", repr(line)) from error
        read = partial(read_panorama, folder / f"{number:03d}.jpg")
        panorama = Panorama(name=f"{number:03d}", T_world_panorama=pose, read=read)
        found.append(("".join(words[8:9]), panorama))
    if not found:
        raise InputError(str(path), "poses of panoramas", "none")
    return found


def symmetric_rooms(count: int) -> list[Place]:
    """Rooms of boxes in pairs, each at half a turn about the room's middle from the other."""
    return [_symmetric_room(SYMMETRIC_SEED + index) for index in range(count)]


def _symmetric_room(seed: int) -> Place:
    rng = np.random.default_rng(seed)
    size = np.array([rng.uniform(4.2, 6.5), rng.uniform(3.2, 4.8), rng.uniform(2.4, 2.9)])
    boxes = [(np.array([0.0, 0.0, size[2] / 2]), size)]
    for wall in range(SYMMETRIC_PAIR_COUNT):
        boxes += _at_wall(size, wall % 2, rng)
    scene = _scene_of(boxes, rng)
    edges = np.concatenate([_edges(*box) for box in boxes])
    line_map = LineMap.from_segments(_in_pieces(edges, rng))
    reach, middle = SYMMETRIC_REACH * size, np.array([0.0, 0.0, size[2] / 2])
    poses = [
        SE3.from_quaternion(
            np.array([0.0, 0.0, np.sin(half_turn), np.cos(half_turn)]),
            middle + rng.uniform(-reach, reach),
        )
        for half_turn in rng.uniform(-np.pi / 2, np.pi / 2, SYMMETRIC_PANORAMA_COUNT)
    ]
    panoramas = tuple(
        Panorama(name=f"{index:03d}", T_world_panorama=pose, read=partial(_picture, scene, pose))
        for index, pose in enumerate(poses)
    )
    return Place(name=f"symmetric_{seed}", kind=SYMMETRIC, line_map=line_map, panoramas=panoramas)


def _at_wall(
    size: FloatArray, axis: int, rng: np.random.Generator
) -> list[tuple[FloatArray, FloatArray]]:
    """A thing at a wall across an axis, and its twin at the wall opposite."""
    extent = np.array([rng.uniform(0.5, 1.4), rng.uniform(0.5, 1.4), rng.uniform(0.4, 2.0)])
    extent[axis] = rng.uniform(0.03, 0.6)
    low = rng.choice([0.0, rng.uniform(0.0, size[2] - extent[2] - 0.1)])
    centre = rng.uniform(-0.5, 0.5, 3) * (size - extent)
    centre[axis] = (size - extent)[axis] / 2
    centre[2] = low + extent[2] / 2
    return [(centre, extent), (centre * [-1.0, -1.0, 1.0], extent)]


def _scene_of(boxes: list[tuple[FloatArray, FloatArray]], rng: np.random.Generator) -> Scene:
    """The first box seen from inside, the others from outside; twins are of one colour."""
    build = SceneBuilder()
    centre, size = boxes[0]
    wall = build.texture(textures.plain(np.full(3, 0.8)))
    for face in BOX_FACES:
        build.quad(centre + face[::-1] * size / 2, wall)
    for first, second in zip(boxes[1::2], boxes[2::2], strict=True):
        colour = build.texture(textures.plain(rng.uniform(0.15, 0.6, 3)))
        build.box(*first, colour)
        build.box(*second, colour)
    return build.scene()


def _edges(centre: FloatArray, size: FloatArray) -> FloatArray:
    """(12, 2, 3) m."""
    bits = np.array([[index >> 2 & 1, index >> 1 & 1, index & 1] for index in range(8)])
    pairs = [(a, a | 1 << bit) for a in range(8) for bit in range(3) if not a >> bit & 1]
    return np.asarray((centre + (bits - 0.5) * size)[np.array(pairs)])


def _in_pieces(edges: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(L, 2, 3) m: edges cut into pieces with noise, as a map built of events has them."""
    cuts = np.linspace(0.0, 1.0, SYMMETRIC_PIECE_COUNT + 1)[:, None]
    points = edges[:, None, 0] * (1 - cuts) + edges[:, None, 1] * cuts
    pieces = np.stack([points[:, :-1], points[:, 1:]], axis=2).reshape(-1, 2, 3)
    return np.asarray(pieces + rng.normal(0.0, SYMMETRIC_NOISE_M, pieces.shape))


def _picture(scene: Scene, pose: SE3) -> Array:
    """(H, 2H) uint8."""
    atlas = texture_atlas(scene.textures, grey=True)
    linear = render_panorama(scene, atlas, pose, SYMMETRIC_WIDTH_PX)[..., 0]
    return np.rint(255.0 * linear.clip(0, 1) ** (1 / 2.2)).astype(np.uint8)
