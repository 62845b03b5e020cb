"""Straight edges of an ordinary photograph, as arcs of great circles in the camera's frame."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from roel_service.arrays import Array, FloatArray
from roel_service.config.stages import LocalizeConfig
from roel_service.errors import InputError
from roel_service.geometry.projection import distort, pixel_from_normalized, ray_from_pixel
from roel_service.geometry.vectors import unit
from roel_service.pano_loc.arcs import BLUR_PX, PanoramaArcs, detect_pieces, whole_arcs
from roel_service.scene.camera import Camera

# Larger photographs are made smaller first.
MAX_SIDE_PX = 1280


def arcs_of_photograph(grey: Array, camera: Camera, config: LocalizeConfig) -> PanoramaArcs:
    """The straight edges of an (H, W) uint8 photograph; rays are in the camera's frame.

    They are looked for in the picture that an ideal pinhole camera of the same focal lengths would
    have taken.

    Raises:
        InputError: a picture of another size than the camera's.
    """
    height, width = grey.shape
    if (width, height) != (camera.width, camera.height):
        expected = f"{camera.width} x {camera.height} pixels, as the camera has"
        raise InputError("photograph", expected, f"{width} x {height}")
    scale = min(1.0, MAX_SIDE_PX / max(width, height))
    size = np.array([round(width * scale), round(height * scale)])
    K = np.diag([scale, scale, 1.0]) @ camera.matrix
    K[:2, 2] += (scale - 1.0) / 2.0
    pixels = np.stack(np.meshgrid(np.arange(size[0]), np.arange(size[1])), axis=-1)
    ideal = (pixels - K[:2, 2]) / np.diagonal(K)[:2]
    place_px = pixel_from_normalized(
        distort(ideal, camera.model, camera.distortion), camera.matrix
    ).astype(np.float32)
    soft = cv2.GaussianBlur(grey, (0, 0), BLUR_PX / scale)
    columns_px, rows_px = (np.ascontiguousarray(place_px[..., axis]) for axis in range(2))
    view = cv2.remap(soft, columns_px, rows_px, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    rays = ray_from_pixel(detect_pieces(view), K)
    arcs = whole_arcs(rays[:, 0], rays[:, 1], config)
    return replace(arcs, sides=_sides(K, size))


def _sides(K: FloatArray, size: Array) -> FloatArray:
    """(4, 3) unit normals of the planes through the centre and the borders, towards the picture."""
    right, bottom = size - 0.5
    corners = ray_from_pixel(
        np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom]]), K
    )
    return unit(np.cross(corners, np.roll(corners, -1, axis=0)))
