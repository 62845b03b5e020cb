"""Equirectangular panoramas: pixels, rays and great circles.

Axes: x forward at the image centre, y left, z up. Column u and row v of an image of W x H, centres
at integers, belong to

    azimuth = pi - (u + 1/2) 2 pi/W,   elevation = pi/2 - (v + 1/2) pi/H,

so azimuth grows to the left, the seam at +-pi lies behind the viewer, and the poles lie half a
pixel outside the first and last row. This module alone adds the half pixel.
"""

from __future__ import annotations

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.geometry.vectors import angle_between, norm

# Sine of the angle to equal or opposite rays below which no great circle is defined by them.
MIN_CIRCLE_SINE = 1e-12


def ray_from_pixel(uv_px: FloatArray, width: int, height: int) -> FloatArray:
    """(*B, 3) unit rays of (*B, 2) panorama pixels (column, row); columns may pass the seam."""
    azimuth_rad = np.pi - (uv_px[..., 0] + 0.5) * (2.0 * np.pi / width)
    elevation_rad = np.pi / 2 - (uv_px[..., 1] + 0.5) * (np.pi / height)
    across = np.cos(elevation_rad)
    return np.stack(
        [across * np.cos(azimuth_rad), across * np.sin(azimuth_rad), np.sin(elevation_rad)],
        axis=-1,
    )


def pixel_from_ray(rays: FloatArray, width: int, height: int) -> FloatArray:
    """Panorama pixels of rays.

    Args:
        rays: (*B, 3) of any length but zero.
        width, height: px.

    Returns:
        (*B, 2) pixels (column, row) in [-1/2, width - 1/2) x [-1/2, height - 1/2]. The poles, which
        have no azimuth, are put in the middle column.
    """
    across = np.hypot(rays[..., 0], rays[..., 1])
    azimuth_rad = np.arctan2(rays[..., 1], rays[..., 0])
    azimuth_rad = np.where(across > 0, azimuth_rad, 0.0)
    elevation_rad = np.arctan2(rays[..., 2], across)
    column = (np.pi - azimuth_rad) * (width / (2.0 * np.pi))
    row = (np.pi / 2 - elevation_rad) * (height / np.pi)
    # Azimuth -pi is the same ray as +pi and belongs to the left edge.
    return np.stack([np.where(column >= width, 0.0, column) - 0.5, row - 0.5], axis=-1)


def great_circle_normal(rays_1: FloatArray, rays_2: FloatArray) -> FloatArray:
    """(*B, 3) unit normals, along ray 1 x ray 2, of the circles through two unit rays.

    NaN for equal or opposite rays, which lie on many circles.
    """
    across = np.cross(rays_1, rays_2)
    sine = norm(across)[..., None]
    return np.asarray(across / np.where(sine < MIN_CIRCLE_SINE, np.nan, sine), dtype=np.float64)


def circle_distance_rad(rays: FloatArray, normals: FloatArray) -> FloatArray:
    """(*B,) angles in [0, pi/2] between rays and the great circles with unit normals."""
    return np.abs(np.pi / 2 - angle_between(normals, rays))


def sample_arc(rays_1: FloatArray, rays_2: FloatArray, count: int) -> FloatArray:
    """Rays at equal angles along shorter arcs, both ends included.

    Args:
        rays_1, rays_2: (*B, 3) unit rays.
        count: number of samples, at least 2.

    Returns:
        (*B, count, 3) unit rays; copies for equal rays, NaN for opposite ones.
    """
    angle_rad = angle_between(rays_1, rays_2)[..., None]
    # Normal to ray 1, towards ray 2; by the circle, as a difference of rays would lose its digits
    # near opposite rays.
    side = np.cross(great_circle_normal(rays_1, rays_2), rays_1)
    equal = np.isnan(side) & (angle_rad < 1.0)
    side = np.where(equal, 0.0, side)  # no arc to follow
    turn_rad = (np.linspace(0.0, 1.0, count) * angle_rad)[..., None]
    return np.asarray(
        np.cos(turn_rad) * rays_1[..., None, :] + np.sin(turn_rad) * side[..., None, :],
        dtype=np.float64,
    )
