"""Panoramas of wireframe rooms, drawn."""

from __future__ import annotations

import cv2
import numpy as np

from roel_service.geometry import sphere
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
