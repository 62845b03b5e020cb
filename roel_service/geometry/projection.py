"""Pinhole and fisheye cameras: rays, ideal pixels, distorted pixels.

Three planes of coordinates: *raw* pixels as the sensor counts them, *normalized* coordinates
(x, y) of the ray (x, y, 1), and *ideal* pixels, those of a pinhole with the same K and no
distortion. Pixel centres are at integers. Camera axes: x right, y down, z forward.
"""

from __future__ import annotations

import math
from enum import Enum
from typing import Protocol

import numpy as np
from numpy.polynomial import Polynomial

from roel_service.arrays import Array, FloatArray
from roel_service.geometry.se3 import SE3, skew
from roel_service.geometry.vectors import unit

# Residual of an undistorted point, in normalized coordinates: 1e-7 px at a focal length of 1000 px.
UNDISTORTION_TOLERANCE = 1e-10
# Newton needs 4 to 6 rounds inside a usual image; near a fold it halves the error per round.
MAX_UNDISTORTION_ROUNDS = 30
# Undistorted points stay this share inside the fold: on the fold the Jacobian is singular.
FOLD_MARGIN = 1e-6
# Points nearer to the plane of the camera centre have no usable pixel; also guards the division.
MIN_DEPTH_M = 1e-9


class CameraModel(Enum):
    """How rays bend before they meet the image."""

    PINHOLE = "pinhole"
    FISHEYE = "fisheye"


class Intrinsics(Protocol):
    """What this module asks of a calibration; `scene.camera.Camera` is one."""

    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...
    @property
    def matrix(self) -> FloatArray: ...
    @property
    def model(self) -> CameraModel: ...
    @property
    def distortion(self) -> tuple[float, ...]: ...


def normalized_from_pixel(xy_px: FloatArray, K: FloatArray) -> FloatArray:
    """(*B, 2) normalized coordinates of (*B, 2) pixels; K (3, 3) without skew."""
    return np.asarray((xy_px - K[:2, 2]) / np.diagonal(K)[:2], dtype=np.float64)


def pixel_from_normalized(xy: FloatArray, K: FloatArray) -> FloatArray:
    """(*B, 2) pixels of (*B, 2) normalized coordinates; K (3, 3) without skew."""
    return np.asarray(xy * np.diagonal(K)[:2] + K[:2, 2], dtype=np.float64)


def ray_from_pixel(xy_px: FloatArray, K: FloatArray) -> FloatArray:
    """(*B, 3) unit rays, camera frame, of (*B, 2) ideal pixels."""
    xy = normalized_from_pixel(xy_px, K)
    return unit(np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1))


def project(points_camera: FloatArray, K: FloatArray) -> FloatArray:
    """(*B, 2) ideal pixels of (*B, 3) points, m, camera frame; NaN at or behind the camera."""
    depth_m = points_camera[..., 2:]
    in_front = np.where(depth_m > MIN_DEPTH_M, depth_m, np.nan)
    return pixel_from_normalized(points_camera[..., :2] / in_front, K)


def clip_to_depth(segments_camera: FloatArray, min_depth_m: float) -> FloatArray:
    """Cut segments to the part in front of a plane parallel to the image.

    Args:
        segments_camera: (*B, 2, 3) endpoints, m, camera frame.
        min_depth_m: z of the plane.

    Returns:
        (*B, 2, 3) segments with z >= min_depth_m; NaN where nothing is left.
    """
    depth_m = segments_camera[..., 2]
    behind = depth_m < min_depth_m
    rise_m = depth_m[..., ::-1] - depth_m
    crossing = behind.any(axis=-1, keepdims=True) & ~behind.all(axis=-1, keepdims=True)
    fraction = (min_depth_m - depth_m) / np.where(crossing, rise_m, np.nan)
    cuts = segments_camera + fraction[..., None] * (segments_camera[..., ::-1, :] - segments_camera)
    return np.asarray(np.where(behind[..., None], cuts, segments_camera), dtype=np.float64)


def viewing_plane_normal(segments_px: FloatArray, K: FloatArray) -> FloatArray:
    """Unit normals of the planes through the camera centre and 2D segments.

    Args:
        segments_px: (*B, 2, 2) endpoints, ideal pixels.
        K: (3, 3) calibration matrix, px.

    Returns:
        (*B, 3) normals, camera frame, parallel to start ray x end ray; NaN for zero length.
    """
    rays = ray_from_pixel(segments_px, K)
    return unit(np.cross(rays[..., 0, :], rays[..., 1, :]))


def image_line_from_moment(moment_camera: FloatArray, K: FloatArray) -> FloatArray:
    """Image of infinite 3D lines, from their moments in the camera frame.

    Args:
        moment_camera: (*B, 3) moments about the camera centre, any length but zero.
        K: (3, 3) calibration matrix, px.

    Returns:
        (*B, 3) coefficients (a, b, c) with a x + b y + c = 0 and a^2 + b^2 = 1, so that the left
        side is a distance in px. NaN for a line through the camera centre, which is a point, and
        for one in the plane z = 0, whose image is at infinity.
    """
    line = moment_camera @ np.linalg.inv(K)
    length = np.linalg.norm(line[..., :2], axis=-1, keepdims=True)
    return np.asarray(line / np.where(length > 0, length, np.nan), dtype=np.float64)


def fundamental_matrix(K_1: FloatArray, K_2: FloatArray, T_2_1: SE3) -> FloatArray:
    """(*B, 3, 3) matrices F with x_2^T F x_1 = 0 for homogeneous ideal pixels of one point.

    Args:
        K_1, K_2: (3, 3) calibration matrices, px.
        T_2_1: (*B) `p_2 = T_2_1 @ p_1` between the camera frames.
    """
    essential = skew(T_2_1.translation) @ T_2_1.rotation
    return np.asarray(np.linalg.inv(K_2).T @ essential @ np.linalg.inv(K_1), dtype=np.float64)


def distort(xy: FloatArray, model: CameraModel, coefficients: tuple[float, ...]) -> FloatArray:
    """Bend ideal rays as the lens does.

    Args:
        xy: (*B, 2) ideal normalized coordinates.
        model: pinhole takes 0, 4, 5 or 8 coefficients (k1 k2 p1 p2 [k3 [k4 k5 k6]]), fisheye
            takes 4 (k1 k2 k3 k4), both in OpenCV's order.
        coefficients: of the model.

    Returns:
        (*B, 2) distorted normalized coordinates.
    """
    xy = np.asarray(xy, dtype=np.float64)
    if not coefficients:
        return xy.copy()
    if model is CameraModel.FISHEYE:
        return _distort_equidistant(xy, coefficients)
    return _distort_radial_tangential(xy, _RadialTangential(coefficients))[0]


def undistort(xy: FloatArray, model: CameraModel, coefficients: tuple[float, ...]) -> FloatArray:
    """Straighten distorted rays; the inverse of `distort`.

    A distortion polynomial rises with the angle of the ray only up to its first fold; beyond, two
    rays share one pixel. Only the ray inside the fold is an answer.

    Args:
        xy: (*B, 2) distorted normalized coordinates.
        model: as in `distort`.
        coefficients: as in `distort`.

    Returns:
        (*B, 2) ideal normalized coordinates, `distort` of them within `UNDISTORTION_TOLERANCE` of
        xy. NaN marks what did not converge: points that no ray inside the fold reaches, and
        fisheye rays 90 degrees or more off the axis, which no pinhole image holds.
    """
    xy = np.asarray(xy, dtype=np.float64)
    if not coefficients:
        return xy.copy()
    if model is CameraModel.FISHEYE:
        return _undistort_equidistant(xy, coefficients)
    return _undistort_radial_tangential(xy, _RadialTangential(coefficients))


def undistortion_table(camera: Intrinsics) -> Array:
    """(height, width, 2) float32: the ideal pixel of every raw pixel, indexed [row, column].

    Pixels that cannot be undistorted (see `undistort`) hold NaN.
    """
    rows, columns = np.mgrid[: camera.height, : camera.width]
    xy = normalized_from_pixel(np.stack([columns, rows], axis=-1), camera.matrix)
    ideal = undistort(xy, camera.model, camera.distortion)
    return pixel_from_normalized(ideal, camera.matrix).astype(np.float32)


class _RadialTangential:
    """Coefficients of the radial-tangential model, as polynomials in s = x^2 + y^2."""

    def __init__(self, coefficients: tuple[float, ...]) -> None:
        k1, k2, p1, p2, k3, k4, k5, k6 = (*coefficients, 0.0, 0.0, 0.0, 0.0)[:8]
        self.numerator = Polynomial([1.0, k1, k2, k3])
        self.denominator = Polynomial([1.0, k4, k5, k6])
        self.p1 = p1
        self.p2 = p2
        # d(numerator/denominator)/ds = slope / denominator^2
        self.slope = (
            self.numerator.deriv() * self.denominator - self.numerator * self.denominator.deriv()
        )

    @property
    def fold_radius(self) -> float:
        """Radius at which r * radial(r^2) stops rising, or has a pole; infinite without one.

        The tangential part, a small tilt of the lens, is left out here.
        """
        rise = self.numerator * self.denominator + Polynomial([0.0, 2.0]) * self.slope
        return min(_first_fold(rise), _first_fold(self.denominator))


def _first_fold(rise: Polynomial) -> float:
    """Square root of the smallest positive real root, or infinity."""
    roots = rise.trim().roots()
    real = roots.real[(np.abs(roots.imag) <= 1e-12 * np.abs(roots)) & (roots.real > 0)]
    return math.sqrt(real.min()) if real.size else math.inf


def _distort_radial_tangential(
    xy: FloatArray, lens: _RadialTangential
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """(*B, 2) distorted coordinates and the entries xx, xy, yy of their symmetric Jacobian."""
    x, y = xy[..., 0], xy[..., 1]
    s = x * x + y * y
    denominator = lens.denominator(s)
    radial = lens.numerator(s) / denominator
    slope = lens.slope(s) / denominator**2
    p1, p2 = lens.p1, lens.p2
    distorted = np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x),
            y * radial + p1 * (s + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )
    along_x = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    across = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    along_y = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    return distorted, along_x, across, along_y


def _undistort_radial_tangential(xy: FloatArray, lens: _RadialTangential) -> FloatArray:
    """Newton's method in two dimensions, kept inside the fold."""
    limit = lens.fold_radius * (1.0 - FOLD_MARGIN)
    ideal = _shorten(xy, limit)
    for _ in range(MAX_UNDISTORTION_ROUNDS):
        distorted, along_x, across, along_y = _distort_radial_tangential(ideal, lens)
        error = distorted - xy
        determinant = along_x * along_y - across * across
        converged = (np.abs(error).max(axis=-1) < UNDISTORTION_TOLERANCE) & (determinant > 0)
        if converged.all():
            break
        determinant = np.where(determinant > 0, determinant, np.nan)
        step = np.stack(
            [
                along_y * error[..., 0] - across * error[..., 1],
                along_x * error[..., 1] - across * error[..., 0],
            ],
            axis=-1,
        )
        moved = _shorten(ideal - step / determinant[..., None], limit)
        ideal = np.where(converged[..., None], ideal, moved)
    return np.where(converged[..., None], ideal, np.nan)


def _shorten(xy: FloatArray, limit: float) -> FloatArray:
    """(*B, 2) vectors, those longer than the limit cut to it."""
    length = np.linalg.norm(xy, axis=-1, keepdims=True)
    return np.asarray(xy * (limit / np.maximum(length, limit)) if limit < math.inf else xy)


def _equidistant(coefficients: tuple[float, ...]) -> Polynomial:
    """Distorted angle as an odd polynomial in the angle of the ray, both rad."""
    k1, k2, k3, k4 = coefficients
    return Polynomial([0.0, 1.0, 0.0, k1, 0.0, k2, 0.0, k3, 0.0, k4])


def _distort_equidistant(xy: FloatArray, coefficients: tuple[float, ...]) -> FloatArray:
    radius = np.linalg.norm(xy, axis=-1, keepdims=True)
    distorted_rad = _equidistant(coefficients)(np.arctan(radius))
    # On the axis the ratio's limit is 1, and there is nothing to scale.
    return np.asarray(xy * np.where(radius > 0, distorted_rad / np.where(radius > 0, radius, 1), 1))


def _undistort_equidistant(xy: FloatArray, coefficients: tuple[float, ...]) -> FloatArray:
    """Newton's method in the angle of the ray, kept inside the fold and below 90 degrees."""
    profile = _equidistant(coefficients)
    rise = profile.deriv()
    # In theta^2, so that the root search is the same as for the other model.
    fold_rad = _first_fold(Polynomial(rise.coef[::2]))
    limit_rad = min(fold_rad * (1.0 - FOLD_MARGIN), math.pi / 2)
    distorted_rad = np.linalg.norm(xy, axis=-1)
    angle_rad = np.minimum(distorted_rad, limit_rad)
    for _ in range(MAX_UNDISTORTION_ROUNDS):
        error_rad = profile(angle_rad) - distorted_rad
        converged = np.abs(error_rad) < UNDISTORTION_TOLERANCE
        if converged.all():
            break
        moved_rad = np.clip(angle_rad - error_rad / rise(angle_rad), 0.0, limit_rad)
        angle_rad = np.where(converged, angle_rad, moved_rad)
    inside = converged & (angle_rad < math.pi / 2)
    on_axis = distorted_rad == 0
    scale = np.tan(np.where(inside, angle_rad, np.nan)) / np.where(on_axis, np.nan, distorted_rad)
    return np.asarray(xy * np.where(on_axis, 1.0, scale)[..., None], dtype=np.float64)
