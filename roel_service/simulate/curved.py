"""A room of round things: how maps fare where edges are no lines."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.simulate import textures
from roel_service.simulate.rooms import SceneBuilder, Wall, door, shell, window
from roel_service.simulate.scenes import Scene

# Straight sides of what stands for a circle: half a millimetre from it at a radius of half a
# metre, and neighbouring sides differ in brightness by too little for an event.
SIDE_COUNT = 64
UP = np.array([0.0, 0.0, 1.0])
# What stands in a corner stands this far from both walls.
CORNER_M = 0.75


class RoundBuilder:
    """Adds surfaces of revolution and flat rings to a scene, and keeps their rims."""

    def __init__(self, build: SceneBuilder) -> None:
        self.build = build
        self.rims: list[FloatArray] = []

    def plain(self, colour: FloatArray) -> int:
        """Number of a texture of one colour."""
        return self.build.texture(textures.plain(colour))

    def disc(self, middle: FloatArray, rim: FloatArray, texture: int) -> None:
        """Fill a rim about its middle, seen from where it turns left."""
        # Two steps a piece: four corners make two triangles, both with an area.
        for k in range(0, len(rim) - 1, 2):
            self.build.quad(np.stack([middle, *rim[k : k + 3]]), texture)

    def band(self, rim: FloatArray, other: FloatArray, texture: int) -> None:
        """The surface between two rims, seen from where they turn left, the first one below."""
        for k in range(len(rim) - 1):
            corners = np.stack([rim[k], rim[k + 1], other[k + 1], other[k]])
            self.build.quad(corners, texture)

    def cylinder(
        self, foot: FloatArray, radius_m: float, height_m: float, side: int, top: int
    ) -> None:
        """An upright cylinder without its bottom."""
        lower = self.rim(circle(foot, radius_m))
        upper = self.rim(circle(foot + height_m * UP, radius_m))
        self.band(lower, upper, side)
        self.disc(foot + height_m * UP, upper, top)

    def rim(self, points: FloatArray) -> FloatArray:
        """Remember a round edge, (n, 3) m."""
        self.rims.append(points)
        return points


def circle(
    middle: FloatArray,
    radius_m: float,
    *,
    right: FloatArray | None = None,
    up: FloatArray | None = None,
    turn_rad: float = 2 * np.pi,
) -> FloatArray:
    """(n + 1, 3) m: a circle, or a part of it, from `right` towards `up`; level by default."""
    right = np.array([1.0, 0.0, 0.0]) if right is None else right
    up = np.array([0.0, 1.0, 0.0]) if up is None else up
    angle = np.linspace(0.0, turn_rad, SIDE_COUNT + 1)[:, None]
    return np.asarray(middle + radius_m * (np.cos(angle) * right + np.sin(angle) * up))


def curved_room(rng: np.random.Generator) -> Scene:
    """A room with round tables, stools, columns, pots, a rug, mirrors, a clock and an arch."""
    size = np.array([rng.uniform(4.4, 5.6), rng.uniform(4.4, 5.4), rng.uniform(2.5, 2.9)])
    build = SceneBuilder()
    shell(build, size, rng)
    round_things = RoundBuilder(build)
    walls = [Wall(side, size) for side in rng.permutation(4)]
    _arch(round_things, walls[0], rng)
    door(build, walls[1], 1.0, rng)
    _mirror(round_things, walls[1], -0.25 * walls[1].width_m, rng)
    window(build, walls[2], rng)
    for side in (-1, 1):
        _mirror(round_things, walls[3], side * rng.uniform(0.1, 0.2) * walls[3].width_m, rng)
    furniture: tuple[Callable[[RoundBuilder, FloatArray, np.random.Generator], None], ...] = (
        _table,
        _table,
        _column,
        _pots,
    )
    signs = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
    for add, sign in zip(furniture, rng.permutation(signs), strict=True):
        place = size[:2] / 2 + sign * (size[:2] / 2 - CORNER_M)
        add(round_things, np.append(place, 0.0), rng)
    return replace(build.scene(), rims=tuple(round_things.rims))


def _table(add: RoundBuilder, foot: FloatArray, rng: np.random.Generator) -> None:
    """A round table on one leg."""
    wood = rng.uniform(0.35, 0.8) * np.array([1.0, 0.85, 0.65])
    dark = add.plain(0.4 * wood)
    add.cylinder(foot, 0.25, 0.03, dark, dark)
    add.cylinder(foot + 0.03 * UP, 0.04, 0.65, dark, dark)
    below = foot + 0.68 * UP
    radius_m = rng.uniform(0.35, 0.55)
    # The board's lower side is looked at from below.
    add.disc(below, circle(below, radius_m)[::-1], dark)
    add.cylinder(below, radius_m, 0.04, dark, add.plain(wood))
    plate_m = below + 0.04 * UP + rng.uniform(-0.1, 0.1, 3) * [1.0, 1.0, 0.0]
    add.cylinder(plate_m, 0.13, 0.015, dark, add.plain(np.full(3, 0.92)))


def _column(add: RoundBuilder, foot: FloatArray, rng: np.random.Generator) -> None:
    """A half-high column between two plates, with a pot on it."""
    stone = rng.uniform(0.5, 0.8) * np.ones(3)
    radius_m, height_m = rng.uniform(0.15, 0.22), rng.uniform(0.9, 1.3)
    plate, shaft = add.plain(stone), add.plain(0.55 * stone)
    add.cylinder(foot, 1.3 * radius_m, 0.08, plate, plate)
    add.cylinder(foot + 0.08 * UP, radius_m, height_m, shaft, shaft)
    top = foot + (0.08 + height_m) * UP
    add.disc(top, circle(top, 1.3 * radius_m)[::-1], shaft)
    add.cylinder(top, 1.3 * radius_m, 0.06, plate, plate)
    _pot(add, top + 0.06 * UP, 0.6 * radius_m, rng)


def _pots(add: RoundBuilder, foot: FloatArray, rng: np.random.Generator) -> None:
    """Stools and pots side by side."""
    for step in (-0.45, 0.0, 0.4):
        place = foot + np.array([step, -step, 0.0]) * rng.uniform(0.8, 1.0)
        _pot(add, place, rng.uniform(0.12, 0.2), rng)


def _pot(add: RoundBuilder, foot: FloatArray, radius_m: float, rng: np.random.Generator) -> None:
    """A conical pot with a brim."""
    clay = add.plain(rng.uniform(0.1, 0.6, 3))
    height_m = rng.uniform(1.2, 2.4) * radius_m
    lower = add.rim(circle(foot, 0.7 * radius_m))
    upper = add.rim(circle(foot + height_m * UP, radius_m))
    add.band(lower, upper, clay)
    brim_m = foot + height_m * UP
    brim = add.rim(circle(brim_m, 1.15 * radius_m))
    add.disc(brim_m, brim[::-1], clay)
    above = add.rim(circle(brim_m + 0.03 * UP, 1.15 * radius_m))
    add.band(brim, above, clay)
    add.disc(brim_m + 0.03 * UP, above, add.plain(rng.uniform(0.6, 0.95, 3)))


def _mirror(add: RoundBuilder, wall: Wall, along_m: float, rng: np.random.Generator) -> None:
    """A round picture in a frame."""
    radius_m, up_m = rng.uniform(0.2, 0.38), rng.uniform(1.35, 1.7)
    frame, glass = add.plain(rng.uniform(0.05, 0.3, 3)), add.plain(rng.uniform(0.6, 0.95, 3))
    # Turning left as seen from inside.
    right = -wall.right
    back = add.rim(circle(wall.at(along_m, up_m, 0.0), radius_m, right=right, up=UP))
    front = add.rim(circle(wall.at(along_m, up_m, 0.03), radius_m, right=right, up=UP))
    inner = add.rim(circle(wall.at(along_m, up_m, 0.03), 0.8 * radius_m, right=right, up=UP))
    add.band(back, front, frame)
    add.band(front, inner, frame)
    add.disc(wall.at(along_m, up_m, 0.03), inner, glass)
    wall.take(along_m, 2 * radius_m)


def _arch(add: RoundBuilder, wall: Wall, rng: np.random.Generator) -> None:
    """A frame with a round top around a dark niche."""
    along_m, radius_m = rng.uniform(-0.15, 0.15) * wall.width_m, rng.uniform(0.45, 0.6)
    spring_m = 1.95 - radius_m
    frame, dark = add.plain(np.full(3, rng.uniform(0.75, 0.95))), add.plain(np.full(3, 0.08))
    axes = {"right": -wall.right, "up": UP}

    def half(radius_m: float, out_m: float) -> FloatArray:
        middle = wall.at(along_m, spring_m, out_m)
        return add.rim(circle(middle, radius_m, turn_rad=np.pi, **axes))

    back, front = half(radius_m + 0.1, 0.0), half(radius_m + 0.1, 0.05)
    inner, niche = half(radius_m, 0.05), half(radius_m, 0.01)
    add.band(back, front, frame)
    add.band(front, inner, frame)
    add.band(inner, niche, frame)
    add.disc(wall.at(along_m, spring_m, 0.01), niche, dark)
    wall.box(add.build, (along_m, spring_m / 2, 0.0), (2 * radius_m, 0.01, spring_m), dark)
    for side in (-1, 1):
        place = (along_m + side * (radius_m + 0.05), spring_m / 2, 0.0)
        wall.box(add.build, place, (0.1, 0.05, spring_m), frame)
