"""Distances between lines and planes on the affine Grassmannian, and their derivatives.

The paper measures how far a 3D line is from a viewing plane by embedding both in a Grassmannian,
origin shifted to the line. Written out, that distance is two numbers: with unit normal n, camera
centre c, line direction v and a point c0 of the line,

    r1 = n . v,   r2 = d / sqrt(1 + d^2),   d = n . (c0 - c) / length_scale,   e = r1^2 + r2^2 < 2.

An event and a line pass the camera centre both ray and plane, which leaves one number, u . m/|m|.

Derivatives are by line, four numbers as in `plucker.retract_orthonormal`, and by pose, six numbers
(r, d) as in `SE3.retract` of T_world_camera.
"""

from __future__ import annotations

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.geometry.plucker import (
    arc_length,
    camera_moment_jacobians,
    moment_from_point,
    nearest_to_origin,
    plucker_from_orthonormal,
    plucker_jacobians,
    transform_lines,
)
from roel_service.geometry.se3 import SE3, skew
from roel_service.geometry.vectors import any_normal, dot, norm, unit


def line_basis(direction: FloatArray, point: FloatArray) -> FloatArray:
    """Lines as points of Gr(2, 4).

    Args:
        direction: (*B, 3) unit vectors.
        point: (*B, 3) any point of each line, m.

    Returns:
        (*B, 4, 2) orthonormal bases Y of the embedded lines.
    """
    foot = nearest_to_origin(direction, moment_from_point(point, direction))
    return _embed(direction[..., None], foot)


def plane_basis(normal: FloatArray, point: FloatArray) -> FloatArray:
    """Planes as points of Gr(3, 4).

    Args:
        normal: (*B, 3) unit vectors.
        point: (*B, 3) any point of each plane, m.

    Returns:
        (*B, 4, 3) orthonormal bases Y of the embedded planes.
    """
    first = any_normal(normal)
    second = np.cross(normal, first)
    foot = arc_length(normal, point)[..., None] * normal
    return _embed(np.stack([first, second], axis=-1), foot)


def _embed(basis: FloatArray, displacement: FloatArray) -> FloatArray:
    """Y of Graff(k, 3) in Gr(k + 1, 4): basis (*B, 3, k), displacement (*B, 3) normal to it."""
    displacement = np.asarray(displacement)
    length = np.sqrt(1.0 + dot(displacement, displacement))
    k = basis.shape[-1]
    Y = np.zeros((*displacement.shape[:-1], 4, k + 1))
    Y[..., :3, :k] = basis
    Y[..., :3, k] = displacement / length[..., None]
    Y[..., 3, k] = 1.0 / length
    return Y


def principal_angles(Y_1: FloatArray, Y_2: FloatArray) -> FloatArray:
    """Principal angles between linear subspaces, by singular values.

    Args:
        Y_1: (*B, n, k) orthonormal basis.
        Y_2: (*B, n, l) orthonormal basis, k <= l.

    Returns:
        (*B, k) angles in [0, pi/2] rad, ascending.
    """
    overlap = np.swapaxes(Y_2, -1, -2) @ Y_1
    cosine = np.linalg.svd(overlap, compute_uv=False)
    # Sines come from the part of Y_1 outside Y_2; the arccosine has no digits left below 1e-8.
    sine = np.linalg.svd(Y_1 - Y_2 @ overlap, compute_uv=False)[..., ::-1]
    return np.asarray(np.arctan2(sine, cosine), dtype=np.float64)


def plane_line_residual(
    normal: FloatArray,
    centre: FloatArray,
    direction: FloatArray,
    foot: FloatArray,
    length_scale_m: FloatArray | float = 1.0,
) -> FloatArray:
    """Grassmann residual between viewing planes and lines, origin shifted to the line.

    Both components vanish exactly when the line lies in the plane. The sign of the line changes
    the sign of the first alone, that of the normal changes both.

    Args:
        normal: (*B, 3) unit normals of the viewing planes, world.
        centre: (*B, 3) camera centres, m, world.
        direction: (*B, 3) unit line directions, world.
        foot: (*B, 3) any point of each line, m, world.
        length_scale_m: (*B,) length that counts as one; 1 m in the paper.

    Returns:
        (*B, 2) values n.v and d/sqrt(1 + d^2) with d = n.(foot - centre)/length_scale_m.
    """
    d = dot(normal, foot - centre) / length_scale_m
    return np.stack(np.broadcast_arrays(dot(normal, direction), d / np.sqrt(1.0 + d * d)), axis=-1)


def plane_line_angle(
    normal: FloatArray,
    centre: FloatArray,
    direction: FloatArray,
    foot: FloatArray,
    length_scale_m: FloatArray | float = 1.0,
) -> FloatArray:
    """The one principal angle between planes and lines that is not zero.

    sin^2 theta = ((n.v)^2 + d^2) / (1 + d^2), arguments as in `plane_line_residual`.

    Returns:
        (*B,) angles in [0, pi/2] rad.
    """
    d = dot(normal, foot - centre) / length_scale_m
    # |n x v| rather than sqrt(1 - (n.v)^2), which has few digits left when the line is upright.
    within = norm(np.cross(normal, direction))
    return np.asarray(np.arctan2(np.hypot(dot(normal, direction), d), within), dtype=np.float64)


def plane_line_jacobians(
    normal: FloatArray,
    centre: FloatArray,
    U: FloatArray,
    phi: FloatArray,
    along_m: FloatArray | float,
    length_scale_m: FloatArray | float = 1.0,
) -> tuple[FloatArray, FloatArray]:
    """Derivatives of `plane_line_residual` with foot = v x m + along_m v.

    The arc length along_m, the length scale and, in the camera frame, the normal are held fixed.

    Args:
        normal: (*B, 3) unit normals of the viewing planes, world.
        centre: (*B, 3) camera centres, m, world.
        U: (*B, 3, 3) rotations of the orthonormal form, world.
        phi: (*B,) rad.
        along_m: (*B,) arc length of the point of the line.
        length_scale_m: (*B,) as in `plane_line_residual`.

    Returns:
        (*B, 2, 4) by line and (*B, 2, 6) by pose.
    """
    direction, moment = plucker_from_orthonormal(U, phi)
    by_direction, by_moment = plucker_jacobians(U, phi)
    along_m = np.asarray(along_m)
    foot = nearest_to_origin(direction, moment) + along_m[..., None] * direction
    by_foot = (
        skew(direction) @ by_moment
        - skew(moment) @ by_direction
        + along_m[..., None, None] * by_direction
    )
    view = foot - centre
    scale_m = np.asarray(length_scale_m)
    d = dot(normal, view) / scale_m
    gain = ((1.0 + d * d) ** -1.5 / scale_m)[..., None]
    row = normal[..., None, :]
    by_line = np.stack(
        [(row @ by_direction)[..., 0, :], gain * (row @ by_foot)[..., 0, :]], axis=-2
    )
    tilt = np.concatenate([np.cross(normal, direction), np.zeros_like(view)], axis=-1)
    offset = np.concatenate([np.cross(normal, view), np.broadcast_to(-normal, view.shape)], axis=-1)
    return by_line, np.stack([tilt, gain * offset], axis=-2)


def camera_plane_normal(
    T_world_camera: SE3, direction: FloatArray, moment: FloatArray
) -> FloatArray:
    """Unit normals of the planes through camera centres and lines.

    Args:
        T_world_camera: (*B) poses.
        direction: (*B, 3) unit line directions, world.
        moment: (*B, 3) m, world.

    Returns:
        (*B, 3) m_c/|m_c|, camera frame; NaN for a line through the camera centre.
    """
    return unit(transform_lines(T_world_camera.inverse(), direction, moment)[1])


def ray_line_residual(
    rays: FloatArray, T_world_camera: SE3, direction: FloatArray, moment: FloatArray
) -> FloatArray:
    """Event residual: sine of the angle between rays and the planes through lines and centre.

    Args:
        rays: (*B, 3) unit rays, camera frame.
        T_world_camera: (*B) poses.
        direction: (*B, 3) unit line directions, world.
        moment: (*B, 3) m, world.

    Returns:
        (*B,) values u . m_c/|m_c|; NaN for a line through the camera centre.
    """
    return dot(rays, camera_plane_normal(T_world_camera, direction, moment))


def camera_plane_jacobians(
    T_world_camera: SE3, U: FloatArray, phi: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Derivatives of `camera_plane_normal`.

    Those of the moment m_c in the camera frame, then (I - n n^T)/|m_c| for its direction n.

    Args:
        T_world_camera: (*B) poses.
        U: (*B, 3, 3) rotations of the orthonormal form, world.
        phi: (*B,) rad.

    Returns:
        (*B, 3, 4) by line and (*B, 3, 6) by pose; NaN for a line through the camera centre.
    """
    direction, moment = plucker_from_orthonormal(U, phi)
    moment_camera = transform_lines(T_world_camera.inverse(), direction, moment)[1]
    length_m = norm(moment_camera)[..., None, None]
    normal = unit(moment_camera)[..., None]
    tangent = (np.eye(3) - normal * np.swapaxes(normal, -1, -2)) / np.where(
        length_m > 0, length_m, np.nan
    )
    by_line, by_pose = camera_moment_jacobians(T_world_camera, U, phi)
    return tangent @ by_line, tangent @ by_pose


def ray_line_jacobians(
    rays: FloatArray, T_world_camera: SE3, U: FloatArray, phi: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Derivatives of `ray_line_residual`: (*B, 4) by line and (*B, 6) by pose.

    Args:
        rays: (*B, 3) unit rays, camera frame.
        T_world_camera: (*B) poses.
        U: (*B, 3, 3) rotations of the orthonormal form, world.
        phi: (*B,) rad.
    """
    by_line, by_pose = camera_plane_jacobians(T_world_camera, U, phi)
    row = rays[..., None, :]
    return (row @ by_line)[..., 0, :], (row @ by_pose)[..., 0, :]
