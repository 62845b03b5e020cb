"""True lines against a map: how many of those that could be seen are in it.

Room layouts know their lines exactly but not what stands before them; a line counts as seen where
it is inside the picture.
"""

from __future__ import annotations

import math

import numpy as np

from roel_service.arrays import BoolArray, FloatArray
from roel_service.geometry.projection import project
from roel_service.geometry.segments import length, point_segment_distance
from roel_service.mapping.frames import Frames
from roel_service.scene.lines import LineMap

# A true line counts if this much of it was in this many pictures, and is found if a map line lies
# this close to this share of that.
MIN_LENGTH_M = 0.5
MIN_FRAME_COUNT = 10
MAX_DISTANCE_M = 0.03
MIN_COVERED_SHARE = 0.7
SAMPLE_SPACING_M = 0.01


def coverage_figures(
    truth: FloatArray, line_map: LineMap, frames: Frames
) -> dict[str, float | int | None]:
    """How many of (L, 2, 3) true lines, m, a map covers.

    Returns:
        `true_line_count` of those that count, `covered_line_count`, and their ratio
        `covered_line_share`; `covered_length_share` of all that was seen of them.
    """
    counted, covered, seen_count, covered_count = 0, 0, 0, 0
    for line in truth:
        points = _samples(line)
        points = points[_is_seen(points, frames)]
        if len(points) * SAMPLE_SPACING_M <= MIN_LENGTH_M:
            continue
        near = _distances_m(points, line_map) <= MAX_DISTANCE_M
        counted += 1
        covered += bool(near.mean() >= MIN_COVERED_SHARE)
        seen_count += len(points)
        covered_count += int(near.sum())
    return {
        "true_line_count": counted,
        "covered_line_count": covered,
        "covered_line_share": covered / counted if counted else None,
        "covered_length_share": covered_count / seen_count if counted else None,
    }


def _samples(line: FloatArray) -> FloatArray:
    """(n, 3) m, evenly along a (2, 3) segment, in the middles of equal pieces."""
    count = max(1, math.ceil(float(length(line)) / SAMPLE_SPACING_M))
    share = ((np.arange(count) + 0.5) / count)[:, None]
    return np.asarray((1.0 - share) * line[0] + share * line[1])


def _is_seen(points: FloatArray, frames: Frames) -> BoolArray:
    """(n,) whether enough pictures hold each of (n, 3) points."""
    counts = np.zeros(len(points), np.int64)
    for index in range(len(frames)):
        pixels = project(frames.T_world_camera[index].inverse() @ points, frames.K)
        with np.errstate(invalid="ignore"):  # points behind the camera have no pixel
            size = np.array([frames.width, frames.height])
            counts += ((pixels > -0.5) & (pixels < size - 0.5)).all(axis=1)
    return np.asarray(counts >= MIN_FRAME_COUNT)


def _distances_m(points: FloatArray, line_map: LineMap) -> FloatArray:
    """(n,) m from each of (n, 3) points to the nearest line of a map."""
    nearest = np.full(len(points), np.inf)
    for segment in line_map.segments:
        np.minimum(nearest, point_segment_distance(points, segment), out=nearest)
    return nearest
