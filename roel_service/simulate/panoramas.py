"""Equirectangular pictures: six square views, resampled."""

from __future__ import annotations

import cv2
import numpy as np

from roel_service.arrays import Array, FloatArray
from roel_service.geometry import sphere
from roel_service.geometry.se3 import SE3
from roel_service.simulate.render import render
from roel_service.simulate.scenes import Scene, TextureAtlas

# `R_panorama_camera` of the six views: forward, left, back, right, up, down. Columns are the
# camera's axes (right, down, forward) in the panorama's frame (x forward, y left, z up).
FACE_ROTATIONS = np.array(
    [
        [[0, 0, 1], [-1, 0, 0], [0, -1, 0]],
        [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
        [[0, 0, -1], [1, 0, 0], [0, -1, 0]],
        [[-1, 0, 0], [0, 0, -1], [0, -1, 0]],
        [[0, 1, 0], [-1, 0, 0], [0, 0, 1]],
        [[0, -1, 0], [-1, 0, 0], [0, 0, -1]],
    ],
    dtype=np.float64,
)
# Each view reaches this far beyond 90 degrees, so that interpolation never leaves it.
FACE_HALF_WIDTH = 1.02


def render_panorama(scene: Scene, atlas: TextureAtlas, T_world_panorama: SE3, width: int) -> Array:
    """(width / 2, width, C) float32 linear intensity; x forward at the centre, y left, z up.

    Args:
        scene: surfaces.
        atlas: their textures.
        T_world_panorama: pose.
        width: px.
    """
    size = width // 2
    focal_px = 0.5 * size / FACE_HALF_WIDTH
    K = np.array([[focal_px, 0, (size - 1) / 2], [0, focal_px, (size - 1) / 2], [0, 0, 1.0]])
    columns, rows = np.meshgrid(np.arange(width), np.arange(width // 2))
    rays = sphere.ray_from_pixel(np.stack([columns, rows], axis=-1), width, width // 2)
    result = np.zeros((width // 2, width, atlas.texels.shape[1]), np.float32)
    facing = np.argmax(rays @ FACE_ROTATIONS[:, :, 2].T, axis=-1)
    for face, R_panorama_camera in enumerate(FACE_ROTATIONS):
        T_panorama_camera = SE3(rotation=R_panorama_camera, translation=np.zeros(3))
        view = render(scene, atlas, T_world_panorama @ T_panorama_camera, K, size, size)
        mask = facing == face
        x, y, z = (rays[mask] @ R_panorama_camera).T
        place = np.stack([focal_px * x / z + K[0, 2], focal_px * y / z + K[1, 2]], axis=-1)
        result[mask] = _sampled(view, place)
    return result


def _sampled(view: Array, place_px: FloatArray) -> Array:
    """(n, C) bilinear values of a view at (n, 2) px."""
    x, y = place_px.astype(np.float32).T[:, :, None]
    # remap takes at most 32767 rows: hand the points over as a table.
    columns = 4096
    padding = (0, -len(x) % columns)
    x = np.pad(x[:, 0], padding).reshape(-1, columns)
    y = np.pad(y[:, 0], padding).reshape(-1, columns)
    sampled = cv2.remap(view, x, y, cv2.INTER_LINEAR)
    return np.asarray(sampled.reshape(-1, view.shape[2])[: len(place_px)])
