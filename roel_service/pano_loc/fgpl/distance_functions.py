"""Line and point distance functions on the sphere, of a picture and of a map at many places."""

from __future__ import annotations

import numpy as np

from roel_service.arrays import Array, FloatArray
from roel_service.pano_loc.arcs import PanoramaArcs
from roel_service.pano_loc.fgpl import distance_kernels
from roel_service.pano_loc.fgpl.intersections import Intersections
from roel_service.pano_loc.fgpl.principal_directions import QUERY_LEVEL, sphere_points

# Distances of points count to this power, which tells near ones apart.
POINT_POWER = 0.2
CHANNEL_COUNT = 6


def query_rays() -> FloatArray:
    """(642, 3) unit: where distances are asked for."""
    return sphere_points(QUERY_LEVEL)


def functions_of_picture(
    arcs: PanoramaArcs,
    channel: Array,
    points: Intersections,
    R_picture_query: FloatArray,
    *,
    points_by_class: bool,
) -> Array:
    """(642, 6) float32: angles to lines of each class, and powers of those to points.

    Args:
        arcs: the picture's.
        channel: (A,) class of each.
        points: intersections of arcs.
        R_picture_query: (3, 3) turns the query rays into the picture.
        points_by_class: as in `FgplParameters`.
    """
    rays = np.ascontiguousarray(query_rays() @ R_picture_query.T)
    lines = distance_kernels.line_distances(arcs.starts, arcs.ends, channel, rays)
    near = distance_kernels.point_distances(points.points, points.pair, rays)
    return _joined(lines, near, points_by_class)


def functions_of_map(
    segments: FloatArray,
    channel: Array,
    points: Intersections,
    places: FloatArray,
    *,
    points_by_class: bool,
) -> Array:
    """(T, 642, 6) float32, the same as seen from (T, 3) places, without a turn."""
    found = np.empty((len(places), len(query_rays()), CHANNEL_COUNT), np.float32)
    rays = np.ascontiguousarray(query_rays())
    for index, place in enumerate(places):
        starts, ends = distance_kernels.seen_from(segments, place)
        lines = distance_kernels.line_distances(starts, ends, channel, rays)
        offset = points.points - place
        distance_m = np.maximum(np.linalg.norm(offset, axis=1, keepdims=True), 1e-9)
        near = distance_kernels.point_distances(offset / distance_m, points.pair, rays)
        found[index] = _joined(lines, near, points_by_class)
    return found


def _joined(lines: Array, by_pair: Array, points_by_class: bool) -> Array:
    # Direction k takes part in the pairs k and k - 1.
    points = np.minimum(by_pair, np.roll(by_pair, 1, axis=-1)) if points_by_class else by_pair
    return np.concatenate([lines, points**POINT_POWER], axis=-1)
