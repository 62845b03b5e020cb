"""Straight edges of a mesh, exact where edge points are but voxels: the measure of sub-pixel bias."""

from __future__ import annotations

import math

import numpy as np

from roel_bench.visible_edges import VisibleEdges
from roel_service.arrays import FloatArray, IntArray
from roel_service.geometry import segments as seg
from roel_service.geometry.projection import clip_to_depth, project
from roel_service.geometry.se3 import SE3
from roel_service.geometry.vectors import unit
from roel_service.scene.clouds import TriangleMesh

# Two surfaces that meet at a smaller angle are one.
MIN_CREASE_RAD = math.radians(20)
# Corners closer than this are one.
CORNER_M = 1e-4
# A scanned surface has creases everywhere, and none of them is a straight edge.
MAX_TRIANGLE_COUNT = 20_000
NEAR_M = 0.05
# A found line belongs to a crease this close to it, if no other one is nearly as close.
MAX_OFFSET_PX = 2.0
MIN_RUNNER_UP_PX = 4.0
SAME_PLACE_PX = 0.05
MAX_ANGLE_RAD = math.radians(2)
MIN_FACING_SHARE = 0.9


def crease_segments(mesh: TriangleMesh) -> FloatArray:
    """(C, 2, 3) m: edges of a single triangle, or of two that meet at an angle."""
    if len(mesh) > MAX_TRIANGLE_COUNT:
        return np.empty((0, 2, 3))
    triangles = mesh.triangles.astype(np.float64)
    normal = unit(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]))
    corner_key = np.unique(
        np.rint(triangles.reshape(-1, 3) / CORNER_M).astype(np.int64), axis=0, return_inverse=True
    )[1].reshape(-1, 3)
    ends = np.concatenate([corner_key[:, [k, (k + 1) % 3]] for k in range(3)])
    places = np.concatenate([triangles[:, [k, (k + 1) % 3]] for k in range(3)])
    normals = np.tile(normal, (3, 1))
    _, first, edge = np.unique(
        np.sort(ends, axis=1), axis=0, return_index=True, return_inverse=True
    )
    # All triangles of a flat edge have the normal of its first one, up to sign.
    along_first = np.abs(np.sum(normals * normals[first][edge], axis=1))
    flattest = np.full(len(first), np.inf)
    np.minimum.at(flattest, edge, along_first)
    is_crease = (np.bincount(edge) == 1) | (flattest < math.cos(MIN_CREASE_RAD))
    return np.asarray(places[first[is_crease]])


def offsets_px(
    segments_px: FloatArray,
    creases: FloatArray,
    visible: VisibleEdges,
    T_world_camera: SE3,
    K: FloatArray,
) -> FloatArray:
    """Where the visible crease lies that each line of a picture was drawn from.

    Args:
        segments_px: (S, 2, 2) ideal px.
        creases: (C, 2, 3) m, world.
        visible: tells what hides a crease.
        T_world_camera: pose of the picture.
        K: (3, 3) calibration, px.

    Returns:
        (S,) signed distance of the crease from the middle of the line along the line's left normal;
        NaN for a line that belongs to no crease, or might belong to several.
    """
    in_camera = clip_to_depth(T_world_camera.inverse() @ creases, NEAR_M)
    projected = project(in_camera, K)
    in_front = np.isfinite(projected).all(axis=(1, 2))
    in_camera, projected = in_camera[in_front], projected[in_front]
    if len(segments_px) == 0 or len(projected) == 0:
        return np.full(len(segments_px), np.nan)
    line, crease = _only_partners(segments_px, projected)
    middle_px = seg.midpoint(segments_px[line])
    points = T_world_camera @ _point_at(middle_px, projected[crease], in_camera[crease])
    seen = visible.is_visible(points, T_world_camera.translation)
    line, crease, middle_px = line[seen], crease[seen], middle_px[seen]
    offsets = np.full(len(segments_px), np.nan)
    foot_px = middle_px - _from_line(middle_px, projected[crease])
    offsets[line] = seg.point_line_offset(foot_px, segments_px[line])
    return offsets


def _only_partners(lines: FloatArray, creases: FloatArray) -> tuple[IntArray, IntArray]:
    """Lines with exactly one crease nearby, and that crease; creases on one place count as one."""
    here, there = lines[:, None], creases[None]
    belongs = (seg.angle_rad(here, there) < MAX_ANGLE_RAD) & (
        seg.overlap(there, here) > MIN_FACING_SHARE
    )
    distance_px = np.where(belongs, seg.perpendicular_one_way(here, there), np.inf)
    crease = distance_px.argmin(axis=1)
    nearest_px = distance_px.min(axis=1, keepdims=True)
    rivals = (distance_px > nearest_px + SAME_PLACE_PX) & (distance_px < MIN_RUNNER_UP_PX)
    line = np.flatnonzero((nearest_px[:, 0] < MAX_OFFSET_PX) & ~rivals.any(axis=1))
    return line, crease[line]


def _point_at(middle_px: FloatArray, projected: FloatArray, in_camera: FloatArray) -> FloatArray:
    """(n, 3) m, camera: the point of each crease that is seen beside (n, 2) px."""
    share = seg.position_along(middle_px, projected)[:, None]
    near_m, far_m = in_camera[:, 0, 2:], in_camera[:, 1, 2:]
    # Equal steps in the image are no equal steps along the line: inverse depth is linear.
    share = share * near_m / (far_m + share * (near_m - far_m))
    return np.asarray((1.0 - share) * in_camera[:, 0] + share * in_camera[:, 1])


def _from_line(points_px: FloatArray, lines: FloatArray) -> FloatArray:
    """(n, 2) px: from the foot on each infinite line to the point."""
    offset = seg.point_line_offset(points_px, lines)
    return np.asarray(offset[:, None] * seg.left_normal(lines))
