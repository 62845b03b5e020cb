"""Distances of observed ends from the images of 3D lines: the cost of LIMAP.

With the moment m_c of a line in the camera frame its image is a = K^-T m_c, and the signed distance
of a pixel p = (x, y, 1) from it d = a . p / |(a_1, a_2)|, in px.

Derivatives are by line, four numbers as in `plucker.retract_orthonormal`, and by pose, six numbers
(r, d) as in `SE3.retract` of T_world_camera.
"""

from __future__ import annotations

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.geometry.plucker import (
    camera_moment_jacobians,
    plucker_from_orthonormal,
    transform_lines,
)
from roel_service.geometry.projection import image_line_from_moment
from roel_service.geometry.se3 import SE3


def end_line_distances_px(
    segments_px: FloatArray,
    T_world_camera: SE3,
    direction: FloatArray,
    moment: FloatArray,
    K: FloatArray,
) -> FloatArray:
    """Signed distances of the ends of observed segments from the images of infinite lines.

    Args:
        segments_px: (*B, 2, 2) observed, ideal px.
        T_world_camera: (*B) poses.
        direction: (*B, 3) unit line directions, world.
        moment: (*B, 3) m, world.
        K: (3, 3) calibration matrix, px.

    Returns:
        (*B, 2) px, signs as the line's; NaN for a line through the camera centre.
    """
    moment_camera = transform_lines(T_world_camera.inverse(), direction, moment)[1]
    line = image_line_from_moment(moment_camera, K)[..., None, :]
    return np.asarray(np.vecdot(segments_px, line[..., :2]) + line[..., 2])


def end_line_jacobians(
    segments_px: FloatArray, T_world_camera: SE3, U: FloatArray, phi: FloatArray, K: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Derivatives of `end_line_distances_px`: dd/da = (p - d (a_1, a_2, 0)/n)/n, n = |(a_1, a_2)|.

    Args:
        segments_px: (*B, 2, 2) observed, ideal px.
        T_world_camera: (*B) poses.
        U: (*B, 3, 3) rotations of the orthonormal form, world.
        phi: (*B,) rad.
        K: (3, 3) calibration matrix, px.

    Returns:
        (*B, 2, 4) by line and (*B, 2, 6) by pose; NaN for a line through the camera centre.
    """
    direction, moment = plucker_from_orthonormal(U, phi)
    moment_camera = transform_lines(T_world_camera.inverse(), direction, moment)[1]
    image_from_moment = np.linalg.inv(K).T
    length = np.linalg.norm((moment_camera @ image_from_moment.T)[..., :2], axis=-1)
    length = np.where(length > 0, length, np.nan)[..., None, None]
    distance = end_line_distances_px(segments_px, T_world_camera, direction, moment, K)
    pull = image_line_from_moment(moment_camera, K) * np.array([1.0, 1.0, 0.0])
    pixels = np.concatenate([segments_px, np.ones((*segments_px.shape[:-1], 1))], axis=-1)
    by_moment = (pixels - distance[..., None] * pull[..., None, :]) / length @ image_from_moment
    by_line, by_pose = camera_moment_jacobians(T_world_camera, U, phi)
    return by_moment @ by_line, by_moment @ by_pose
