"""Panoramas and photographs of wireframe rooms, drawn."""

from __future__ import annotations

import cv2
import numpy as np

from roel_service.geometry import sphere
from roel_service.geometry.projection import project
from roel_service.geometry.segments import sample_segments


def wireframe_panorama(T_world_panorama, segments, width):
    """(width / 2, width) uint8: bright lines on dark ground, nothing hidden."""
    points, line = sample_segments(segments, 0.02)
    place = sphere.pixel_from_ray(T_world_panorama.inverse() @ points, width, width // 2)
    pieces = np.stack([place[:-1], place[1:]], axis=1)
    joined = (line[1:] == line[:-1]) & (np.abs(np.diff(place[:, 0])) < width / 2)
    picture = np.full((width // 2, width), 30, np.uint8)
    chains = list(np.rint(16 * pieces[joined]).astype(np.int32))
    cv2.polylines(picture, chains, False, 220, 2, cv2.LINE_AA, 4)
    return picture


def wireframe_photograph(T_world_camera, segments, camera):
    """(H, W) uint8: bright lines on dark ground, nothing hidden."""
    points, line = sample_segments(segments, 0.02)
    points = T_world_camera.inverse() @ points
    place = project(np.where(points[:, 2:] > 0.1, points, np.nan), camera.matrix)
    pieces = np.stack([place[:-1], place[1:]], axis=1)
    kept = (line[1:] == line[:-1]) & (np.abs(pieces) < 4000).all(axis=(1, 2))
    picture = np.full((camera.height, camera.width), 30, np.uint8)
    cv2.polylines(
        picture, list(np.rint(16 * pieces[kept]).astype(np.int32)), False, 220, 2, cv2.LINE_AA, 4
    )
    return picture
