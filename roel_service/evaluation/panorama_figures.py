"""Pictures of panoramas with the map's lines drawn over them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from roel_service.arrays import Array
from roel_service.geometry import sphere
from roel_service.geometry.se3 import SE3
from roel_service.geometry.segments import sample_segments
from roel_service.scene.lines import LineMap

LINE_COLOR_BGR = (40, 90, 255)
# Straight lines are curves in a panorama: drawn as chains of such short pieces, m.
PIECE_M = 0.02


def draw_overlay(grey: Array, line_map: LineMap, T_world_panorama: SE3 | None, path: Path) -> None:
    """Write a PNG of an (H, 2H) uint8 panorama with the map's lines where a pose puts them.

    Without a pose the picture stays bare. Lines are drawn whether or not something hides them.
    """
    import cv2

    height, width = grey.shape
    picture = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    if T_world_panorama is not None:
        points, line = sample_segments(line_map.segments, PIECE_M)
        rays = T_world_panorama.inverse() @ points
        place_px = sphere.pixel_from_ray(rays, width, height)
        joined = (line[1:] == line[:-1]) & (np.abs(np.diff(place_px[:, 0])) < width / 2)
        # Fixed-point coordinates with four binary digits.
        pieces = np.stack([place_px[:-1], place_px[1:]], axis=1)[joined]
        chains = list(np.rint(16 * pieces).astype(np.int32))
        thickness = max(1, round(width / 1500))
        cv2.polylines(picture, chains, False, LINE_COLOR_BGR, thickness, cv2.LINE_AA, 4)
    path.write_bytes(cv2.imencode(".png", picture)[1].tobytes())
