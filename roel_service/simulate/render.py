"""Pinhole pictures of a scene, with several samples a pixel.

A depth-buffer renderer of our own: edges have to move smoothly between pictures, at hundreds of
pictures a second on one core (measured against ray casting in `docs/decisions`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roel_service.arrays import Array, FloatArray
from roel_service.geometry.se3 import SE3
from roel_service.simulate import render_kernels
from roel_service.simulate.scenes import Scene, TextureAtlas

# Positions of the samples in a pixel: every row and every column of a 6 x 6 grid holds one, so that
# upright and level edges, too, pass six steps on their way through a pixel.
SAMPLE_OFFSETS = (np.array([[0, 3], [1, 0], [2, 4], [3, 1], [4, 5], [5, 2]]) + 0.5) / 6 - 0.5
# Surfaces nearer than this are cut away, in units of the scene's longest side.
NEAR_SHARE = 1e-3


@dataclass(frozen=True, eq=False, kw_only=True)
class Picture:
    """One view of the scene.

    Attributes:
        colour: (H, W, C) float32, linear intensity.
        depth_m: (H, W) float64, z in the camera at the centre of the pixel; infinite where nothing
            is hit.
    """

    colour: Array
    depth_m: FloatArray


def render(
    scene: Scene,
    atlas: TextureAtlas,
    T_world_camera: SE3,
    K: FloatArray,
    width: int,
    height: int,
) -> Picture:
    """Render with `SAMPLE_OFFSETS`; pixel centres are at integers.

    Args:
        scene: surfaces.
        atlas: their textures; its channels become those of the picture.
        T_world_camera: pose.
        K: (3, 3) calibration matrix, px.
        width, height: px.
    """
    image, counts, functions, order = _project(scene, T_world_camera, K, width, height)
    colour = np.zeros((height, width, atlas.texels.shape[1]), np.float32)
    # A sample's footprint has the side of a pixel over the root of their number.
    sharpness = 0.5 * np.log2(len(SAMPLE_OFFSETS))
    for offset_x, offset_y in SAMPLE_OFFSETS:
        _, visible = _visible(image, counts, functions, order, width, height, offset_x, offset_y)
        render_kernels.shade(
            visible,
            functions,
            scene.texture,
            scene.brightness,
            atlas.texels,
            atlas.offset,
            atlas.height,
            atlas.width,
            atlas.level_count,
            offset_x,
            offset_y,
            sharpness,
            scene.background,
            colour,
        )
    nearest, _ = _visible(image, counts, functions, order, width, height, 0.0, 0.0)
    return Picture(colour=colour / len(SAMPLE_OFFSETS), depth_m=_depth(nearest))


def render_depth(
    scene: Scene, T_world_camera: SE3, K: FloatArray, width: int, height: int
) -> FloatArray:
    """(H, W) z in the camera, m, at the pixel centres; infinite where nothing is hit."""
    image, counts, functions, order = _project(scene, T_world_camera, K, width, height)
    return _depth(_visible(image, counts, functions, order, width, height, 0.0, 0.0)[0])


def _project(
    scene: Scene, T_world_camera: SE3, K: FloatArray, width: int, height: int
) -> tuple[Array, Array, Array, Array]:
    in_camera = T_world_camera.inverse() @ scene.triangles
    corners = np.concatenate([in_camera, scene.uv], axis=-1)
    near_m = NEAR_SHARE * float(np.ptp(scene.bounds_m, axis=0).max())
    projected: tuple[Array, Array, Array, Array] = render_kernels.project_triangles(
        corners, K, near_m, width, height
    )
    return projected


def _visible(
    image: Array,
    counts: Array,
    functions: Array,
    order: Array,
    width: int,
    height: int,
    offset_x: float,
    offset_y: float,
) -> tuple[Array, Array]:
    """Inverse depth (H, W) and triangle (H, W) at one position of every pixel."""
    nearest = np.zeros((height, width))
    visible = np.full((height, width), -1, np.int64)
    render_kernels.fill_triangles(
        image, counts, functions, order, offset_x, offset_y, nearest, visible
    )
    return nearest, visible


def _depth(nearest: Array) -> FloatArray:
    return np.where(nearest > 0, 1.0 / np.where(nearest > 0, nearest, 1.0), np.inf)
