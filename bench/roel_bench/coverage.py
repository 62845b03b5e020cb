"""True lines against a map: how many of those that could be seen are in it.

Room layouts know their lines exactly, but not whether anything tells the wall from the ceiling
there. So every measure is given twice: of the lines that were in the picture, and of those along
which events fell.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from roel_bench.results import Figures
from roel_service.arrays import Array, BoolArray, FloatArray, IntArray
from roel_service.geometry.projection import project
from roel_service.geometry.segments import length, point_segment_distance
from roel_service.mapping.frames import Frames, frame_slices
from roel_service.scene.events import EventSource
from roel_service.scene.lines import LineMap

# A true line counts if this much of it was seen in this many pictures, and is covered if map lines
# lie this close to this share of that.
MIN_LENGTH_M = 0.5
MIN_FRAME_COUNT = 10
MAX_DISTANCE_M = 0.03
MIN_COVERED_SHARE = 0.7
SAMPLE_SPACING_M = 0.01
# Events fall along a line where one is this near to it in this time; layouts are drawn by hand.
ACTIVE_RADIUS_PX = 6
ACTIVE_HALF_WINDOW_US = 16_000


def coverage_figures(
    truth: FloatArray, line_map: LineMap, frames: Frames, events: EventSource, ideal_px: Array
) -> Figures:
    """How many of (L, 2, 3) true lines, m, a map covers.

    Args:
        truth: true lines.
        line_map: what was found.
        frames: in which lines count as seen.
        events: that the map was made from.
        ideal_px: (H, W, 2) undistortion table of the camera.

    Returns:
        `true_line_count` of the lines that were in the picture and `covered_line_share` of them;
        `active_line_count` and `covered_active_line_share` of those along which events fell.
    """
    samples = [_samples(line) for line in truth]
    points = np.concatenate(samples)
    in_view, active = _seen_counts(points, frames, events, ideal_px)
    near = _distances_m(points, line_map) <= MAX_DISTANCE_M
    line = np.repeat(np.arange(len(samples)), [len(part) for part in samples])
    true_count, share = _covered(line, in_view >= MIN_FRAME_COUNT, near)
    active_count, active_share = _covered(line, active >= MIN_FRAME_COUNT, near)
    return {
        "true_line_count": true_count,
        "covered_line_share": share,
        "active_line_count": active_count,
        "covered_active_line_share": active_share,
    }


def _samples(line: FloatArray) -> FloatArray:
    """(n, 3) m, evenly along a (2, 3) segment, in the middles of equal pieces."""
    count = max(1, math.ceil(float(length(line)) / SAMPLE_SPACING_M))
    share = ((np.arange(count) + 0.5) / count)[:, None]
    return np.asarray((1.0 - share) * line[0] + share * line[1])


def _covered(line: IntArray, seen: BoolArray, near: BoolArray) -> tuple[int, float | None]:
    """Lines of which enough was seen, and the share of them that is covered."""
    seen_count = np.bincount(line[seen], minlength=int(line.max()) + 1)
    near_count = np.bincount(line[seen & near], minlength=len(seen_count))
    counts = seen_count * SAMPLE_SPACING_M > MIN_LENGTH_M
    if not counts.any():
        return 0, None
    covered = near_count[counts] >= MIN_COVERED_SHARE * seen_count[counts]
    return int(counts.sum()), float(covered.mean())


def _seen_counts(
    points: FloatArray, frames: Frames, events: EventSource, ideal_px: Array
) -> tuple[IntArray, IntArray]:
    """In how many pictures each of (n, 3) points was, and in how many with events beside it."""
    in_view, active = np.zeros(len(points), np.int64), np.zeros(len(points), np.int64)
    slices = frame_slices(events.chunks(), frames.t_us.tolist(), ACTIVE_HALF_WINDOW_US)
    for index, (t_us, stream) in enumerate(slices):
        around = stream.around(t_us, ACTIVE_HALF_WINDOW_US)
        fell = _event_map(ideal_px[around.y, around.x], frames)
        pixels = project(frames.T_world_camera[index].inverse() @ points, frames.K)
        with np.errstate(invalid="ignore"):  # points behind the camera have no pixel
            size = np.array([frames.width, frames.height])
            inside = ((pixels > -0.5) & (pixels < size - 0.5)).all(axis=1)
        column, row = np.rint(pixels[inside]).astype(np.intp).T
        in_view += inside
        active[inside] += fell[row, column]
    return in_view, active


def _event_map(pixels: Array, frames: Frames) -> BoolArray:
    """(H, W) whether an event fell nearby; pixels (K, 2), ideal, NaN outside the lens."""
    pixels = np.rint(pixels[np.isfinite(pixels).all(axis=1)])
    size = np.array([frames.width, frames.height])
    column, row = pixels[((pixels >= 0) & (pixels < size)).all(axis=1)].astype(np.intp).T
    fell = np.zeros((frames.height, frames.width), np.uint8)
    fell[row, column] = 1
    side = 2 * ACTIVE_RADIUS_PX + 1
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    return np.asarray(cv2.dilate(fell, disk) > 0)


def _distances_m(points: FloatArray, line_map: LineMap) -> FloatArray:
    """(n,) m from each of (n, 3) points to the nearest line of a map."""
    nearest = np.full(len(points), np.inf)
    for segment in line_map.segments:
        np.minimum(nearest, point_segment_distance(points, segment), out=nearest)
    return nearest
