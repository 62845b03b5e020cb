"""What is rendered: triangles with textures."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from roel_service.arrays import Array, FloatArray, frozen_array
from roel_service.errors import MeshError
from roel_service.geometry.vectors import unit

# Weights of red, green and blue in the brightness that the event sensor sees (ITU-R BT.601).
LUMINANCE = np.array([0.299, 0.587, 0.114], np.float32)
# Light from above and one side: faces that meet at an edge, and most walls that meet in a corner,
# differ in brightness by more than an event's contrast.
LIGHT = np.array([0.7, 0.4, 0.6])
AMBIENT = 0.72


@dataclass(frozen=True, eq=False, kw_only=True)
class Scene:
    """Textured surfaces.

    Attributes:
        triangles: (T, 3, 3) float64 [triangle, corner, coordinate], m, world, z up.
        uv: (T, 3, 2) texture coordinates of the corners, 0 to 1, rows downwards; the texture
            repeats beyond.
        texture: (T,) int64 index of each triangle's texture.
        brightness: (T,) float32 light on each triangle, a factor of its texture.
        textures: (H, W, 3) float32 images each, linear intensity, 0 to 1, red first.
        background: intensity where nothing is hit.
        rims: (n, 3) m each: the round edges, as chains of points that deviate from the surfaces by
            no more than these do from being round.
    """

    triangles: FloatArray
    uv: FloatArray
    texture: Array
    brightness: Array
    textures: tuple[Array, ...]
    background: float = 0.5
    rims: tuple[FloatArray, ...] = ()

    def __post_init__(self) -> None:
        if len(self.triangles) == 0:
            raise MeshError("scene", "at least one triangle", "none")
        count = len(self.triangles)
        for name, dtype, shape in (
            ("triangles", np.float64, (count, 3, 3)),
            ("uv", np.float64, (count, 3, 2)),
            ("texture", np.int64, (count,)),
            ("brightness", np.float32, (count,)),
        ):
            object.__setattr__(self, name, frozen_array(getattr(self, name), dtype, shape, name))

    @property
    def bounds_m(self) -> FloatArray:
        """(2, 3) lower and upper corner."""
        points = self.triangles.reshape(-1, 3)
        return np.stack([points.min(axis=0), points.max(axis=0)])


def brightness_of(triangles: FloatArray) -> Array:
    """(T,) light on (T, 3, 3) triangles, 1 where they face it."""
    normal = unit(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]))
    facing = np.nan_to_num(normal) @ (LIGHT / np.linalg.norm(LIGHT))
    return np.asarray(AMBIENT + (1.0 - AMBIENT) * facing, dtype=np.float32)


@dataclass(frozen=True, eq=False, kw_only=True)
class TextureAtlas:
    """All textures with their half-sized levels, flat, for the kernels.

    Attributes:
        texels: (N, C) float32.
        offset: (X, M) int64 first texel of each texture's level.
        height, width: (X, M) int64, px.
        level_count: (X,) int64.
    """

    texels: Array
    offset: Array
    height: Array
    width: Array
    level_count: Array


def texture_atlas(textures: tuple[Array, ...], *, grey: bool) -> TextureAtlas:
    """Levels of all textures, each the mean over two by two texels of the one before.

    Args:
        textures: (H, W, 3) float32 each.
        grey: keep the brightness alone, one channel.
    """
    pyramids = [_levels(image @ LUMINANCE[:, None] if grey else image) for image in textures]
    most = max(len(levels) for levels in pyramids)
    offset = np.zeros((len(textures), most), np.int64)
    height, width = np.ones_like(offset), np.ones_like(offset)
    flat = []
    place = 0
    for index, levels in enumerate(pyramids):
        for level, image in enumerate(levels):
            offset[index, level] = place
            height[index, level], width[index, level] = image.shape[:2]
            flat.append(image.reshape(-1, image.shape[2]))
            place += len(flat[-1])
    return TextureAtlas(
        texels=np.concatenate(flat),
        offset=offset,
        height=height,
        width=width,
        level_count=np.array([len(levels) for levels in pyramids]),
    )


def _levels(image: Array) -> list[Array]:
    levels = [np.ascontiguousarray(image, dtype=np.float32)]
    while max(levels[-1].shape[:2]) > 1:
        height, width = (max(1, size // 2) for size in levels[-1].shape[:2])
        smaller = cv2.resize(levels[-1], (width, height), interpolation=cv2.INTER_AREA)
        levels.append(np.asarray(smaller, np.float32).reshape(height, width, -1))
    return levels
