"""Furnished rooms, drawn by chance, and the paper's cube."""

from __future__ import annotations

import numpy as np

from roel_service.arrays import Array, FloatArray
from roel_service.simulate import textures
from roel_service.simulate.scenes import Scene, brightness_of

# Corners of a box's six faces, outwards, as signs along x, y, z; each starts at the lower left as
# seen from outside and turns left.
BOX_FACES = np.array(
    [
        [[1, -1, -1], [1, 1, -1], [1, 1, 1], [1, -1, 1]],
        [[-1, 1, -1], [-1, -1, -1], [-1, -1, 1], [-1, 1, 1]],
        [[1, 1, -1], [-1, 1, -1], [-1, 1, 1], [1, 1, 1]],
        [[-1, -1, -1], [1, -1, -1], [1, -1, 1], [-1, -1, 1]],
        [[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]],
        [[-1, 1, -1], [1, 1, -1], [1, -1, -1], [-1, -1, -1]],
    ],
    dtype=np.float64,
)
# Loose boxes stand this far from the middle of the room, m, and outside the camera's path.
LOOSE_RADIUS_M = (1.2, 2.2)
LOOSE_TRIAL_COUNT = 20
# Boxes up to this height, m, can be stood upon: rugs.
FLAT_M = 0.02


class SceneBuilder:
    """Collects textured rectangles."""

    def __init__(self) -> None:
        self._corners: list[FloatArray] = []
        self._repeats: list[tuple[float, float]] = []
        self._texture: list[int] = []
        self._textures: list[Array] = []
        self._footprints: list[FloatArray] = []

    def texture(self, image: Array) -> int:
        """Add a texture; the number serves any count of surfaces."""
        self._textures.append(image)
        return len(self._textures) - 1

    def quad(
        self, corners: FloatArray, texture: int, repeat: tuple[float, float] = (1.0, 1.0)
    ) -> None:
        """Add a rectangle: (4, 3) corners from the lower left, turning left."""
        self._corners.append(np.asarray(corners, dtype=np.float64))
        self._repeats.append(repeat)
        self._texture.append(texture)

    def box(
        self,
        centre: FloatArray,
        size: FloatArray,
        texture: int,
        *,
        yaw_rad: float = 0.0,
        front: int | None = None,
    ) -> None:
        """Add a box.

        Args:
            centre, size: (3,) m.
            texture: of all faces.
            yaw_rad: turn about the vertical.
            front: texture of the face that looks along -y before the turn.
        """
        cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
        turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        if size[2] > FLAT_M:
            ground = np.asarray(centre) + (BOX_FACES[5] * np.asarray(size) / 2) @ turn.T
            self._footprints.append(np.stack([ground.min(axis=0), ground.max(axis=0)])[:, :2])
        for face, corners in enumerate(BOX_FACES):
            placed = np.asarray(centre) + (corners * np.asarray(size) / 2) @ turn.T
            self.quad(placed, front if front is not None and face == 3 else texture)

    def is_free(self, place: FloatArray, radius_m: float) -> bool:
        """Whether no box but flat ones, at any height, reaches into a circle about (2,) `place`."""
        low, high = np.array(self._footprints).transpose(1, 0, 2)
        outside = np.maximum(low - place, place - high).clip(0.0)
        return bool(np.linalg.norm(outside, axis=1).min() > radius_m)

    def scene(self) -> Scene:
        """Everything so far, two triangles for each rectangle."""
        corners = np.array(self._corners)
        u, v = np.array(self._repeats).T
        zero = np.zeros_like(u)
        # Texture rows run downwards: the lower left corner is (0, 1).
        uv = np.stack(
            [
                np.stack([zero, v], 1),
                np.stack([u, v], 1),
                np.stack([u, zero], 1),
                np.zeros((len(u), 2)),
            ],
            axis=1,
        )
        pick = np.array([[0, 1, 2], [0, 2, 3]])
        triangles = corners[:, pick].reshape(-1, 3, 3)
        return Scene(
            triangles=triangles,
            uv=uv[:, pick].reshape(-1, 3, 2),
            texture=np.repeat(self._texture, 2),
            brightness=brightness_of(triangles),
            textures=tuple(self._textures),
        )


def furnished_room(rng: np.random.Generator) -> Scene:
    """A room of about 4.5 by 4.5 m: floor, walls, door, windows, pictures and furniture."""
    size = np.array([rng.uniform(4.2, 5.6), rng.uniform(4.2, 5.4), rng.uniform(2.5, 2.9)])
    build = SceneBuilder()
    shell(build, size, rng)
    walls = [Wall(side, size) for side in range(4)]
    order = rng.permutation(4)
    # What stands in a corner stands at this end of its wall, so that no two share a corner.
    hand = rng.choice([-1.0, 1.0])
    door(build, walls[order[0]], -hand, rng)
    window(build, walls[order[1]], rng)
    window(build, walls[order[2]], rng)
    _shelf(build, walls[order[3]], hand, rng)
    for wall in walls:
        _pictures(build, wall, rng)
    _cabinet(build, walls[order[1]], hand, rng)
    _sofa(build, walls[order[2]], hand, rng)
    _desk(build, walls[order[0]], hand, rng)
    _loose_boxes(build, size, rng)
    return build.scene()


class Wall:
    """One wall as a frame: along it to the right as seen from inside, up, and into the room."""

    def __init__(self, side: int, size: FloatArray) -> None:
        self.yaw_rad = side * np.pi / 2
        cos, sin = np.rint([np.cos(self.yaw_rad), np.sin(self.yaw_rad)])
        self.right = np.array([-cos, -sin, 0.0])
        self.inward = np.array([sin, -cos, 0.0])
        self.width_m = float(abs(self.right @ size))
        self.height_m = float(size[2])
        middle = np.array([size[0] / 2, size[1] / 2, 0.0])
        self.foot = middle - self.inward * abs(self.inward @ size) / 2
        self._taken: list[tuple[float, float]] = []

    def take(self, along_m: float, width_m: float) -> None:
        """Keep a stretch about `along_m` free of pictures."""
        self._taken.append((along_m - width_m / 2, along_m + width_m / 2))

    def is_free(self, along_m: float, width_m: float) -> bool:
        """Whether nothing was taken within `width_m` about `along_m`."""
        low, high = along_m - width_m / 2, along_m + width_m / 2
        return all(high < begin or low > end for begin, end in self._taken)

    def at(self, along_m: float, up_m: float, out_m: float) -> FloatArray:
        """Point at a distance from the wall's middle, from the floor and from the wall."""
        return np.asarray(self.foot + along_m * self.right + out_m * self.inward + [0.0, 0.0, up_m])

    def box(
        self,
        build: SceneBuilder,
        place: tuple[float, float, float],
        size: tuple[float, float, float],
        texture: int,
        front: int | None = None,
    ) -> None:
        """A box whose back touches the plane `out`: size is (along, out, up), place its middle."""
        along, up, out = place
        centre = self.at(along, up, out + size[1] / 2)
        build.box(centre, np.array(size), texture, yaw_rad=self.yaw_rad, front=front)


def shell(build: SceneBuilder, size: FloatArray, rng: np.random.Generator) -> None:
    """Floor, ceiling with lamps, walls with boards below and above, a rug."""
    floor = textures.planks(14, rng) if rng.random() < 0.6 else textures.tiles(8, rng)
    # Darker than the frames of doors and windows and the cornice.
    wall_colour = rng.uniform(0.35, 0.6) * np.array([1.0, 0.98, 0.94])
    wall = build.texture(textures.mottled(wall_colour, 0.02, 128, rng))
    ceiling = build.texture(textures.mottled(np.full(3, 0.85), 0.015, 128, rng))
    faces = (BOX_FACES[:, ::-1] + 1) / 2 * size
    for face in faces[:4]:
        build.quad(face, wall)
    build.quad(faces[4], ceiling)
    build.quad(faces[5], build.texture(floor), (2.0, 2.0))
    board = build.texture(textures.plain(rng.uniform(0.15, 0.35) * np.array([1.0, 0.9, 0.8])))
    cornice = build.texture(textures.plain(np.full(3, 0.95)))
    for side in range(4):
        edge = Wall(side, size)
        edge.box(build, (0.0, 0.05, 0.0), (edge.width_m, 0.015, 0.1), board)
        edge.box(build, (0.0, size[2] - 0.04, 0.0), (edge.width_m, 0.05, 0.08), cornice)
    for share in (0.3, 0.7):
        _lamp(build, np.array([0.5, share, 1.0]) * size)
    rug = build.texture(textures.stripes(int(rng.integers(6, 11)), rng))
    centre = np.array([size[0] / 2, size[1] / 2, 0.006])
    reach = np.array([rng.uniform(1.2, 2.0), rng.uniform(0.9, 1.5), 0.012])
    build.box(centre, reach, rug, yaw_rad=rng.uniform(-0.4, 0.4))


def _lamp(build: SceneBuilder, place: FloatArray) -> None:
    """A bright panel in a dark frame under the ceiling, at (3,) m."""
    frame = build.texture(textures.plain(np.full(3, 0.3)))
    light = build.texture(textures.plain(np.ones(3)))
    build.box(place - [0.0, 0.0, 0.025], np.array([1.1, 0.35, 0.05]), frame)
    build.box(place - [0.0, 0.0, 0.03], np.array([1.0, 0.25, 0.05]), light)


def door(build: SceneBuilder, wall: Wall, hand: float, rng: np.random.Generator) -> None:
    """A closed door in its frame."""
    along = hand * rng.uniform(0.1, 0.25) * wall.width_m
    frame = build.texture(textures.plain(rng.uniform(0.75, 0.9) * np.ones(3)))
    leaf = rng.uniform(0.2, 0.5) * np.array([1.0, 0.75, 0.5])
    front = build.texture(textures.panels(2, 1, leaf))
    wall.box(build, (along, 1.0, 0.0), (0.9, 0.03, 2.0), build.texture(textures.plain(leaf)), front)
    for side in (-1, 1):
        wall.box(build, (along + side * 0.49, 1.02, 0.0), (0.08, 0.05, 2.04), frame)
    wall.box(build, (along, 2.08, 0.0), (1.06, 0.05, 0.08), frame)
    wall.take(along, 1.06)


def window(build: SceneBuilder, wall: Wall, rng: np.random.Generator) -> None:
    """A window with what is seen through it."""
    width, height = rng.uniform(0.9, 1.5), rng.uniform(0.9, 1.2)
    along = rng.uniform(-0.3, 0.3) * (wall.width_m - width)
    frame = build.texture(textures.plain(np.full(3, 0.88)))
    view = build.texture(textures.window(rng))
    wall.box(build, (along, 1.55, 0.0), (width, 0.02, height), frame, view)
    wall.box(build, (along, 1.55 - height / 2 - 0.03, 0.0), (width + 0.16, 0.14, 0.04), frame)
    wall.take(along, width + 0.16)


def _pictures(build: SceneBuilder, wall: Wall, rng: np.random.Generator) -> None:
    """A picture on either side, where the wall is free."""
    for side in (-1, 1):
        width, height = rng.uniform(0.4, 0.8), rng.uniform(0.3, 0.6)
        place = (side * rng.uniform(0.25, 0.4) * wall.width_m, rng.uniform(1.4, 1.8), 0.0)
        if wall.is_free(place[0], width):
            rim = build.texture(textures.plain(rng.uniform(0.05, 0.3, 3)))
            picture = build.texture(textures.poster(rng))
            wall.box(build, place, (width, 0.03, height), rim, picture)


def _shelf(build: SceneBuilder, wall: Wall, hand: float, rng: np.random.Generator) -> None:
    """A bookshelf with boards and books."""
    width, depth, height = rng.uniform(0.9, 1.4), 0.28, rng.uniform(1.6, 2.0)
    along = hand * rng.uniform(0.0, 0.3) * (wall.width_m - width)
    wood = build.texture(textures.plain(rng.uniform(0.3, 0.7) * np.array([1.0, 0.8, 0.55])))
    for side in (-1, 1):
        place = (along + side * (width / 2 - 0.01), height / 2, 0.0)
        wall.box(build, place, (0.02, depth, height), wood)
    levels = np.linspace(0.05, height, 6)
    for level in levels:
        wall.box(build, (along, level, 0.0), (width, depth, 0.02), wood)
    wall.take(along, width)
    spines = [build.texture(textures.plain(rng.uniform(0.04, 0.85, 3))) for _ in range(8)]
    for level in levels[:-1]:
        position = -width / 2 + 0.03
        limit = width / 2 - rng.uniform(0.05, 0.4)
        while position < limit:
            thick, tall = rng.uniform(0.025, 0.06), rng.uniform(0.18, 0.27)
            place = (along + position + thick / 2, level + 0.01 + tall / 2, 0.02)
            size = (thick - 0.003, rng.uniform(0.14, 0.22), tall)
            wall.box(build, place, size, spines[int(rng.integers(len(spines)))])
            position += thick


def _cabinet(build: SceneBuilder, wall: Wall, hand: float, rng: np.random.Generator) -> None:
    width, depth, height = rng.uniform(0.8, 1.4), 0.45, rng.uniform(0.6, 0.85)
    along = hand * (wall.width_m - width) * 0.4
    colour = rng.uniform(0.3, 0.75) * np.array([1.0, 0.95, 0.85])
    front = build.texture(textures.panels(int(rng.integers(2, 4)), int(rng.integers(2, 4)), colour))
    side = build.texture(textures.plain(0.8 * colour))
    wall.box(build, (along, height / 2, 0.0), (width, depth, height), side, front)
    screen = build.texture(textures.plain(np.full(3, 0.04)))
    shown = build.texture(textures.poster(rng))
    wall.box(build, (along, height + 0.27, 0.15), (0.75, 0.05, 0.44), screen, shown)


def _sofa(build: SceneBuilder, wall: Wall, hand: float, rng: np.random.Generator) -> None:
    width = rng.uniform(1.3, 1.8)
    along = hand * rng.uniform(0.0, 0.2) * (wall.width_m - width)
    cloth = build.texture(textures.mottled(rng.uniform(0.15, 0.5, 3), 0.08, 128, rng))
    wall.box(build, (along, 0.2, 0.1), (width, 0.75, 0.4), cloth)
    wall.box(build, (along, 0.55, 0.1), (width, 0.2, 0.5), cloth)
    for side in (-1, 1):
        wall.box(build, (along + side * (width / 2 + 0.08), 0.3, 0.1), (0.16, 0.75, 0.6), cloth)
    cushion = build.texture(textures.stripes(5, rng))
    wall.box(build, (along + rng.uniform(-0.4, 0.4), 0.58, 0.32), (0.4, 0.12, 0.36), cushion)


def _desk(build: SceneBuilder, wall: Wall, hand: float, rng: np.random.Generator) -> None:
    """A desk with legs, a lamp, a monitor and a chair beside it."""
    width, depth, height = rng.uniform(1.0, 1.4), 0.6, 0.74
    along = hand * (wall.width_m / 2 - width / 2 - 0.1)
    wood = build.texture(textures.plain(rng.uniform(0.35, 0.8) * np.array([1.0, 0.85, 0.65])))
    metal = build.texture(textures.plain(np.full(3, rng.uniform(0.05, 0.2))))
    wall.box(build, (along, height, 0.05), (width, depth, 0.03), wood)
    for side in (-1, 1):
        for out in (0.08, depth - 0.02):
            place = (along + side * (width / 2 - 0.05), height / 2, out)
            wall.box(build, place, (0.04, 0.04, height), metal)
    shown = build.texture(textures.poster(rng))
    wall.box(build, (along, height + 0.3, 0.2), (0.6, 0.04, 0.36), metal, shown)
    wall.box(build, (along, height + 0.06, 0.2), (0.08, 0.04, 0.12), metal)
    wall.box(build, (along + 0.35 * width, height + 0.2, 0.2), (0.05, 0.05, 0.38), metal)
    seat = build.texture(textures.plain(rng.uniform(0.1, 0.6, 3)))
    wall.box(build, (along, 0.45, 0.7), (0.42, 0.4, 0.05), seat)
    wall.box(build, (along, 0.72, 1.06), (0.42, 0.04, 0.5), seat)
    for side in (-1, 1):
        for out in (0.71, 1.06):
            wall.box(build, (along + side * 0.18, 0.22, out), (0.035, 0.035, 0.44), metal)


def _loose_boxes(build: SceneBuilder, size: FloatArray, rng: np.random.Generator) -> None:
    """Boxes on the floor where nothing else stands, outside the circle that the camera walks."""
    for _ in range(LOOSE_TRIAL_COUNT):
        box = rng.uniform([0.2, 0.2, 0.15], [0.5, 0.45, 0.5])
        angle, reach = rng.uniform(0, 2 * np.pi), rng.uniform(*LOOSE_RADIUS_M)
        place = size[:2] / 2 + reach * np.array([np.cos(angle), np.sin(angle)])
        radius_m = float(np.hypot(box[0], box[1])) / 2
        is_inside = (place > radius_m).all() and (place < size[:2] - radius_m).all()
        if not is_inside or not build.is_free(place, radius_m):
            continue
        side = build.texture(textures.plain(rng.uniform(0.1, 0.7, 3)))
        front = build.texture(textures.stripes(int(rng.integers(3, 6)), rng))
        centre = np.append(place, box[2] / 2)
        build.box(centre, box, side, yaw_rad=rng.uniform(0, np.pi), front=front)


def grid_cube(side: float = 10.0) -> Scene:
    """The paper's cube: a two by two grid on each face, centred at the origin, unit-less."""
    build = SceneBuilder()
    face = build.texture(textures.grid(2))
    build.box(np.zeros(3), np.full(3, side), face)
    return build.scene()
