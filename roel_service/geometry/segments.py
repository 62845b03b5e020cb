"""Distances between line segments in the image and in space.

A segment is (*B, 2, D) [endpoint, coordinate], D = 2 in px or D = 3 in m; results carry the unit of
their input. Leading axes broadcast, so `segments[:, None]` against `segments[None]` gives all
pairs. Segments are undirected unless a function says otherwise. A segment of zero length has no
direction: whatever needs one is NaN, which no threshold accepts.

`overlap`, `perspective_distance` and their kin follow LIMAP's definitions.
"""

from __future__ import annotations

import numpy as np

from roel_service.arrays import BoolArray, FloatArray, IntArray
from roel_service.geometry.vectors import angle_between, dot, norm, unit

# Cosine of the angle beyond which two segments count as orthogonal: neither faces the other.
ORTHOGONAL_COSINE = 1e-9
# Share of a segment below which a facing part is a touch: the rounding of a common end.
MIN_FACING_SHARE = 1e-9


def span(segments: FloatArray) -> FloatArray:
    """(*B, D) vectors, start to end."""
    return np.asarray(segments[..., 1, :] - segments[..., 0, :], dtype=np.float64)


def length(segments: FloatArray) -> FloatArray:
    """(*B,) lengths."""
    return norm(span(segments))


def midpoint(segments: FloatArray) -> FloatArray:
    """(*B, D) mid-points."""
    return np.asarray(segments.mean(axis=-2), dtype=np.float64)


def sample_segments(segments: FloatArray, spacing: float) -> tuple[FloatArray, IntArray]:
    """Points that are equally spaced along each segment, both ends included.

    The spacing is the largest one up to `spacing` that divides the segment, so that a segment and
    its reverse have the same points; a segment without length gives its one place twice.

    Args:
        segments: (L, 2, D).
        spacing: in the unit of the segments.

    Returns:
        (P, D) points, and (P,) the segment of each.
    """
    # A millionth of a step is rounding, not another sample.
    steps = np.maximum(np.ceil(length(segments) / spacing - 1e-6), 1.0)
    counts = steps.astype(np.int64) + 1
    segment = np.repeat(np.arange(len(segments)), counts)
    first = np.cumsum(counts) - counts
    fraction = ((np.arange(len(segment)) - first[segment]) / steps[segment])[:, None]
    start, end = segments[segment, 0], segments[segment, 1]
    return np.asarray((1.0 - fraction) * start + fraction * end), segment


def left_normal(segments_px: FloatArray) -> FloatArray:
    """(*B, 2) unit normals (-dy, dx) of 2D segments with unit direction (dx, dy)."""
    direction = unit(span(segments_px))
    return np.stack([-direction[..., 1], direction[..., 0]], axis=-1)


def point_line_offset(points_px: FloatArray, segments_px: FloatArray) -> FloatArray:
    """(*B,) signed distances of 2D points to infinite lines, positive along `left_normal`."""
    return dot(points_px - segments_px[..., 0, :], left_normal(segments_px))


def point_line_distance(points: FloatArray, segments: FloatArray) -> FloatArray:
    """(*B,) distances of (*B, D) points to the infinite lines of segments."""
    offset = points - segments[..., 0, :]
    direction = unit(span(segments))
    return norm(offset - dot(offset, direction)[..., None] * direction)


def point_segment_distance(points: FloatArray, segments: FloatArray) -> FloatArray:
    """(*B,) distances of (*B, D) points to segments; zero length counts as a point."""
    start_to_end = span(segments)
    offset = points - segments[..., 0, :]
    squared = dot(start_to_end, start_to_end)
    fraction = dot(offset, start_to_end) / np.where(squared > 0, squared, 1.0)
    return norm(offset - np.clip(fraction, 0.0, 1.0)[..., None] * start_to_end)


def position_along(points: FloatArray, segments: FloatArray) -> FloatArray:
    """(*B,) where points fall along segments: 0 at the start, 1 at the end, not clipped."""
    start_to_end = span(segments)
    squared = dot(start_to_end, start_to_end)
    offset = points - segments[..., 0, :]
    return dot(offset, start_to_end) / np.where(squared > 0, squared, np.nan)


def angle_rad(segments_1: FloatArray, segments_2: FloatArray) -> FloatArray:
    """(*B,) unsigned angles in [0, pi/2] between infinite lines."""
    direction_1, direction_2 = unit(span(segments_1)), unit(span(segments_2))
    # Kahan's formula: diagonals of the rhombus, exact at all angles and equal in both orders.
    along, against = norm(direction_1 + direction_2), norm(direction_1 - direction_2)
    narrow, wide = np.minimum(along, against), np.maximum(along, against)
    return np.asarray(2.0 * np.arctan2(narrow, wide), dtype=np.float64)


def perpendicular_one_way(segments_1: FloatArray, segments_2: FloatArray) -> FloatArray:
    """(*B,) larger distance of the ends of segment 1 to the infinite line of segment 2."""
    distance = point_line_distance(segments_1, segments_2[..., None, :, :])
    return np.asarray(distance.max(axis=-1), dtype=np.float64)


def perpendicular(segments_1: FloatArray, segments_2: FloatArray) -> FloatArray:
    """(*B,) the larger of the two one-way perpendicular distances."""
    return np.maximum(
        perpendicular_one_way(segments_1, segments_2), perpendicular_one_way(segments_2, segments_1)
    )


def overlap(segments_1: FloatArray, segments_2: FloatArray) -> FloatArray:
    """(*B,) share of segment 2 covered by the projection of segment 1 on it.

    At most 1; negative when disjoint, then minus the gap in lengths of segment 2.
    """
    ends = np.sort(position_along(segments_1, segments_2[..., None, :, :]), axis=-1)
    return np.asarray(np.minimum(ends[..., 1], 1.0) - np.maximum(ends[..., 0], 0.0))


def bi_overlap(segments_1: FloatArray, segments_2: FloatArray) -> FloatArray:
    """(*B,) the larger of the two overlaps."""
    return np.maximum(overlap(segments_1, segments_2), overlap(segments_2, segments_1))


def facing_part(segments_1: FloatArray, segments_2: FloatArray) -> FloatArray:
    """The part of segment 2 that faces segment 1.

    Planes through the ends of segment 1, normal to it, cut segment 2.

    Returns:
        (*B, 2, D) parts, in the order of the ends of segment 1; NaN where nothing faces, which
        includes orthogonal segments and those that only touch.
    """
    direction_1 = unit(span(segments_1))
    start_to_end = span(segments_2)
    advance = dot(start_to_end, direction_1)
    aligned = np.abs(advance) > ORTHOGONAL_COSINE * norm(start_to_end)
    gap = segments_1 - segments_2[..., None, 0, :]
    fraction = dot(gap, direction_1[..., None, :]) / np.where(aligned, advance, np.nan)[..., None]
    fraction = np.clip(fraction, 0.0, 1.0)
    part = segments_2[..., None, 0, :] + fraction[..., None] * start_to_end[..., None, :]
    empty = np.abs(fraction[..., 1] - fraction[..., 0]) <= MIN_FACING_SHARE
    return np.where(empty[..., None, None], np.nan, part)


def inner_segment_distance(segments_1: FloatArray, segments_2: FloatArray) -> FloatArray:
    """(*B,) perpendicular distance of the parts that face each other; infinite if none do.

    Unlike `perpendicular`, it does not grow when a long segment meets a short one.
    """
    distance = perpendicular(
        facing_part(segments_2, segments_1), facing_part(segments_1, segments_2)
    )
    return np.where(np.isnan(distance), np.inf, distance)


def perspective_distance(segments_1: FloatArray, segments_2: FloatArray) -> FloatArray:
    """Relative depth error of two hypotheses for one 2D segment.

    max(|s1 - s2| / z(s1), |e1 - e2| / z(e1)); free of scale. Meaningful only when the ends of both
    lie on the same two rays.

    Args:
        segments_1, segments_2: (*B, 2, 3) m, frame of the camera that saw the 2D segment, ends in
            corresponding order.

    Returns:
        (*B,) dimensionless; infinite where an end of segment 1 is not in front of the camera.
    """
    depth_m = segments_1[..., 2]
    in_front = depth_m > 0
    ratio = norm(segments_1 - segments_2) / np.where(in_front, depth_m, 1.0)
    return np.asarray(np.where(in_front, ratio, np.inf).max(axis=-1), dtype=np.float64)


def midpoint_perpendicular(segments_1: FloatArray, segments_2: FloatArray) -> FloatArray:
    """(*B,) mean distance of each mid-point to the other infinite line."""
    distance_1 = point_line_distance(midpoint(segments_1), segments_2)
    distance_2 = point_line_distance(midpoint(segments_2), segments_1)
    return 0.5 * (distance_1 + distance_2)


def endpoint_distance(segments_1: FloatArray, segments_2: FloatArray) -> FloatArray:
    """(*B,) summed distance of the ends, in the better of the two pairings."""
    along = norm(segments_1 - segments_2).sum(axis=-1)
    against = norm(segments_1 - segments_2[..., ::-1, :]).sum(axis=-1)
    return np.asarray(np.minimum(along, against), dtype=np.float64)


def epipolar_iou(
    segments_1_px: FloatArray, segments_2_px: FloatArray, fundamental: FloatArray
) -> FloatArray:
    """How well the epipolar band of segment 1 agrees with segment 2, both seen along line 2.

    The epipolar lines of the ends of segment 1 cut the line of segment 2 at c1 <= c2, in lengths
    of segment 2; then (min(c2, 1) - max(c1, 0)) / (max(c2, 1) - min(c1, 0)).

    Args:
        segments_1_px, segments_2_px: (*B, 2, 2) ideal px, of two views.
        fundamental: (*B, 3, 3) with x_2^T F x_1 = 0.

    Returns:
        (*B,) at most 1, negative when disjoint; NaN where an epipolar line is parallel to line 2.
    """
    ends_1 = np.concatenate([segments_1_px, np.ones((*segments_1_px.shape[:-1], 1))], axis=-1)
    epipolar = ends_1 @ np.swapaxes(fundamental, -1, -2)
    start = segments_2_px[..., None, 0, :]
    value = dot(epipolar[..., :2], start) + epipolar[..., 2]
    slope = dot(epipolar[..., :2], span(segments_2_px)[..., None, :])
    cuts = np.sort(-value / np.where(slope == 0, np.nan, slope), axis=-1)
    first, last = cuts[..., 0], cuts[..., 1]
    shared = np.minimum(last, 1.0) - np.maximum(first, 0.0)
    return np.asarray(shared / (np.maximum(last, 1.0) - np.minimum(first, 0.0)), dtype=np.float64)


def sensitivity_rad(segments_camera: FloatArray) -> FloatArray:
    """How much a view looks along a 3D segment: 0 broadside, pi/2 along the ray.

    Args:
        segments_camera: (*B, 2, 3) m, camera frame, in front of the camera.

    Returns:
        (*B,) pi/2 minus the unsigned angle to the ray through the mid-point of the projection; NaN
        where an end is not in front of the camera.
    """
    depth_m = segments_camera[..., 2:]
    on_image = segments_camera / np.where(depth_m > 0, depth_m, np.nan)
    angle_to_ray_rad = angle_between(unit(span(segments_camera)), midpoint(on_image))
    return np.abs(np.pi / 2 - angle_to_ray_rad)


def uncertainty_m(
    segments_camera: FloatArray, sigma_px: FloatArray | float, focal_px: float
) -> FloatArray:
    """(*B,) size of an image error at a segment: sigma_px * mean depth / focal_px.

    Args:
        segments_camera: (*B, 2, 3) m, camera frame.
        sigma_px: (*B,) standard deviation of the 2D segment.
        focal_px: focal length.
    """
    return np.asarray(sigma_px * segments_camera[..., 2].mean(axis=-1) / focal_px)


def reaches_box(segments: FloatArray, lower: FloatArray, upper: FloatArray) -> BoolArray:
    """(L,) whether some point of each segment lies in the closed box between two corners."""
    start, direction = segments[..., 0, :], span(segments)
    parallel = direction == 0
    # Where a segment passes the planes of each pair of faces, in units of its length.
    with np.errstate(divide="ignore", invalid="ignore"):
        to_lower = (lower - start) / direction
        to_upper = (upper - start) / direction
    between = (lower <= start) & (start <= upper)
    enter = np.where(parallel, np.where(between, -np.inf, np.inf), np.fmin(to_lower, to_upper))
    leave = np.where(parallel, np.where(between, np.inf, -np.inf), np.fmax(to_lower, to_upper))
    first = np.maximum(enter.max(axis=-1), 0.0)
    last = np.minimum(leave.min(axis=-1), 1.0)
    return np.asarray(first <= last)
