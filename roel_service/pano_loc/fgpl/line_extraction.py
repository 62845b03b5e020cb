"""Lines of a panorama: segments in perspective crops, merged on the sphere."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from roel_service.arrays import Array
from roel_service.geometry.vectors import unit
from roel_service.pano_loc.arcs import Crop, PanoramaArcs, Tiling, crops
from roel_service.pano_loc.fgpl import line_kernels

WIDTH_PX, CROP_PX = 1024, 120
TILING = Tiling(((0.0, 12), (45.0, 6), (-45.0, 6), (90.0, 1), (-90.0, 1)), 60.0)
LSD_QUANT = 0.7


def extract_lines(grey: Array) -> PanoramaArcs:
    """The lines of an (H, 2H) uint8 panorama, longest first."""
    small = cv2.resize(grey, (WIDTH_PX, WIDTH_PX // 2))
    padded = cv2.copyMakeBorder(small, 1, 1, 1, 1, cv2.BORDER_WRAP)
    detector = cv2.createLineSegmentDetector(quant=LSD_QUANT)
    ends = [np.empty((0, 2, 3))]
    for crop in _crops():
        view = cv2.remap(padded, crop.column_px, crop.row_px, cv2.INTER_LINEAR)
        segments = detector.detect(view)[0]
        if segments is not None:
            ends.append(crop.rays(segments.reshape(-1, 2, 2)))
    return merge_lines(np.concatenate(ends))


@lru_cache(maxsize=1)  # beside the default's crops, which are of another size
def _crops() -> tuple[Crop, ...]:
    return crops(WIDTH_PX, CROP_PX, TILING)


def merge_lines(ends: Array) -> PanoramaArcs:
    """Lines of nearly the same normal that overlap, as one; in the order given, greedily.

    Args:
        ends: (S, 2, 3) unit rays.
    """
    if len(ends) == 0:
        return PanoramaArcs.between(np.empty((0, 3)), np.empty((0, 3)))
    normals = unit(np.cross(ends[:, 0], ends[:, 1]))
    ends, normals = ends[~np.isnan(normals[:, 0])], normals[~np.isnan(normals[:, 0])]
    starts, stops = line_kernels.merge(np.ascontiguousarray(ends), normals)
    return PanoramaArcs.between(starts, stops)


def longest(arcs: PanoramaArcs, share: float) -> PanoramaArcs:
    """The longest arcs, that share of all; all of them where it is less than one arc."""
    count = int(share * len(arcs))
    return arcs.take(np.arange(count or len(arcs)))
