"""Infinite 3D lines: endpoints, Pluecker coordinates, orthonormal form, and where lines meet.

A line is (direction v, moment m): v a unit vector, m = p x v in metres for any point p of the line,
hence m normal to v. (v, m) and (-v, -m) are the same line. `v x m` is its *foot*, the point nearest
to the origin, and a point at arc length s is foot + s v.

The orthonormal form holds four degrees of freedom without a constraint: U = (u1, u2, u3) a rotation
with u1 = v and m = tan(phi) u2, so that (w1, w2) = (cos phi, sin phi). Steps of it are
(d1, d2, d3, d4): U <- U Exp(d1, d2, d3), phi <- phi + d4.

What has no answer (a line through two equal points, the intersection of parallel planes) is NaN.
"""

from __future__ import annotations

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.geometry.se3 import SE3, rotation_from_vector, skew
from roel_service.geometry.vectors import MIN_LENGTH, any_normal, dot, norm, unit

# Sine of the angle below which two directions count as parallel: the position of an intersection
# has then lost twelve of float64's sixteen digits.
PARALLEL_SINE = 1e-12


def moment_from_point(point: FloatArray, direction: FloatArray) -> FloatArray:
    """(*B, 3) moments, m, of lines through (*B, 3) points with (*B, 3) unit directions."""
    return np.asarray(np.cross(point, direction), dtype=np.float64)


def plucker_from_endpoints(segments: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lines through the ends of segments.

    Args:
        segments: (*B, 2, 3) endpoints, m.

    Returns:
        (*B, 3) unit directions, start to end, and (*B, 3) moments, m; NaN for equal ends.
    """
    direction = unit(segments[..., 1, :] - segments[..., 0, :])
    return direction, moment_from_point(segments[..., 0, :], direction)


def endpoints_from_plucker(
    direction: FloatArray, moment: FloatArray, interval_m: FloatArray
) -> FloatArray:
    """(*B, 2, 3) segments, m, between the arc lengths interval_m (*B, 2), see `arc_length`."""
    foot = nearest_to_origin(direction, moment)[..., None, :]
    return np.asarray(foot + interval_m[..., None] * direction[..., None, :], dtype=np.float64)


def arc_length(direction: FloatArray, point: FloatArray) -> FloatArray:
    """(*B,) positions, m, along lines of the points nearest to (*B, 3) points; 0 at the foot."""
    return dot(direction, point)


def nearest_to_origin(direction: FloatArray, moment: FloatArray) -> FloatArray:
    """(*B, 3) feet v x m, m."""
    return np.asarray(np.cross(direction, moment), dtype=np.float64)


def nearest_to_point(direction: FloatArray, moment: FloatArray, point: FloatArray) -> FloatArray:
    """(*B, 3) points of lines, m, nearest to (*B, 3) points."""
    foot = nearest_to_origin(direction, moment)
    return foot + arc_length(direction, point)[..., None] * direction


def orthonormal_from_plucker(
    direction: FloatArray, moment: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Orthonormal form of lines (Bartoli and Sturm).

    Args:
        direction: (*B, 3) unit vectors.
        moment: (*B, 3) m.

    Returns:
        (*B, 3, 3) rotations U and (*B,) angles phi in [0, pi/2) rad. For a line through the origin
        phi is 0 and the second column is any unit vector normal to the direction.
    """
    direction, moment = np.broadcast_arrays(direction, moment)
    foot = nearest_to_origin(direction, moment)
    length_m = norm(foot)
    # A moment is normal to its direction; one that is not is the rounding error of zero.
    through_origin = length_m <= np.maximum(0.5 * norm(moment), MIN_LENGTH)
    third = np.where(through_origin[..., None], any_normal(direction), unit(foot))
    U = np.stack([direction, np.cross(third, direction), third], axis=-1)
    return U, np.where(through_origin, 0.0, np.arctan(length_m))


def plucker_from_orthonormal(U: FloatArray, phi: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(*B, 3) unit directions and (*B, 3) moments, m, of (*B, 3, 3) U and (*B,) phi, rad.

    A negative phi is a moment against the second column, so steps may cross the origin.
    """
    return U[..., :, 0], np.asarray(np.tan(phi)[..., None] * U[..., :, 1], dtype=np.float64)


def retract_orthonormal(
    U: FloatArray, phi: FloatArray, delta: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Step lines by (*B, 4) tangents: U <- U Exp(d1, d2, d3), phi <- phi + d4, all rad."""
    return U @ rotation_from_vector(delta[..., :3]), phi + delta[..., 3]


def plucker_jacobians(U: FloatArray, phi: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Derivatives of (direction, moment) by the four numbers of `retract_orthonormal`.

    dv = d3 u2 - d2 u3;  dm = tan(phi) (d1 u3 - d3 u1) + (1 + tan(phi)^2) d4 u2.

    Args:
        U: (*B, 3, 3) rotations.
        phi: (*B,) rad.

    Returns:
        (*B, 3, 4) dv per rad and (*B, 3, 4) dm, m per rad.
    """
    u1, u2, u3 = (U[..., :, axis] for axis in range(3))
    length_m = np.tan(phi)[..., None]
    zero = np.zeros_like(u1)
    by_direction = np.stack([zero, -u3, u2, zero], axis=-1)
    by_moment = np.stack(
        [length_m * u3, zero, -length_m * u1, (1.0 + length_m**2) * u2],
        axis=-1,
    )
    return by_direction, by_moment


def transform_lines(
    T_b_a: SE3, direction: FloatArray, moment: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(*B, 3) directions and (*B, 3) moments, m, in frame b of lines given in frame a."""
    direction_b = T_b_a.rotate(direction)
    return direction_b, T_b_a.rotate(moment) + np.cross(T_b_a.translation, direction_b)


def camera_moment_jacobians(
    T_world_camera: SE3, U: FloatArray, phi: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Derivatives of the moments of lines about camera centres, in the camera frames.

    m_c = R^T (m - c x v) moves by R^T (dm - c x dv) with the line and by
    R^T ([m - c x v]x r + [v]x d) with the pose.

    Args:
        T_world_camera: (*B) poses.
        U: (*B, 3, 3) rotations of the orthonormal form, world.
        phi: (*B,) rad.

    Returns:
        (*B, 3, 4) by line and (*B, 3, 6) by pose.
    """
    R_camera_world = np.swapaxes(T_world_camera.rotation, -1, -2)
    centre = T_world_camera.translation
    direction, moment = plucker_from_orthonormal(U, phi)
    by_direction, by_moment = plucker_jacobians(U, phi)
    about_centre = shift_origin(direction, moment, centre)
    by_line = by_moment - skew(centre) @ by_direction
    by_pose = np.concatenate(np.broadcast_arrays(skew(about_centre), skew(direction)), axis=-1)
    return R_camera_world @ by_line, R_camera_world @ by_pose


def shift_origin(direction: FloatArray, moment: FloatArray, origin: FloatArray) -> FloatArray:
    """(*B, 3) moments, m, about (*B, 3) other origins; directions do not change."""
    return np.asarray(moment - np.cross(origin, direction), dtype=np.float64)


def closest_points(
    direction_1: FloatArray, moment_1: FloatArray, direction_2: FloatArray, moment_2: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The point of each of two lines that is nearest to the other.

    Args:
        direction_1, direction_2: (*B, 3) unit vectors.
        moment_1, moment_2: (*B, 3) m.

    Returns:
        (*B, 3) points of line 1 and (*B, 3) points of line 2, m. Of parallel lines, the foot of
        line 1 and the point of line 2 facing it.
    """
    across = np.cross(direction_1, direction_2)
    sine = norm(across)
    parallel = sine < PARALLEL_SINE
    foot_1 = nearest_to_origin(direction_1, moment_1)
    gap = nearest_to_origin(direction_2, moment_2) - foot_1
    s_1_m = dot(np.cross(gap, direction_2), across) / np.where(parallel, np.inf, sine**2)
    point_1 = foot_1 + s_1_m[..., None] * direction_1
    return point_1, nearest_to_point(direction_2, moment_2, point_1)


def nearest_to_ray(
    direction: FloatArray, moment: FloatArray, ray_origin: FloatArray, ray: FloatArray
) -> FloatArray:
    """Points of lines nearest to rays, which start at their origin and go one way.

    Args:
        direction: (*B, 3) unit vectors.
        moment: (*B, 3) m.
        ray_origin: (*B, 3) m.
        ray: (*B, 3) unit vectors.

    Returns:
        (*B, 3) points of the lines, m. Where the ray leaves the line behind, or runs parallel to
        it, the point nearest to the origin of the ray.
    """
    at_origin = nearest_to_point(direction, moment, ray_origin)
    on_line, on_ray = closest_points(direction, moment, ray, moment_from_point(ray_origin, ray))
    ahead = dot(on_ray - ray_origin, ray) > 0
    parallel = norm(np.cross(direction, ray)) < PARALLEL_SINE
    return np.where((ahead & ~parallel)[..., None], on_line, at_origin)


def intersect_line_plane(
    direction: FloatArray, moment: FloatArray, normal: FloatArray, point: FloatArray
) -> FloatArray:
    """Where lines cut planes.

    Args:
        direction: (*B, 3) unit vectors.
        moment: (*B, 3) m.
        normal: (*B, 3) unit normals of the planes.
        point: (*B, 3) any point of each plane, m.

    Returns:
        (*B, 3) points, m; NaN where line and plane are parallel, also when the line lies in it.
    """
    # Measured from the point of the line that faces the plane's point: exact far from the origin.
    start = nearest_to_point(direction, moment, point)
    slope = dot(normal, direction)
    slope = np.where(np.abs(slope) < PARALLEL_SINE, np.nan, slope)
    return start + (dot(normal, point - start) / slope)[..., None] * direction


def intersect_planes(
    normal_p: FloatArray, point_p: FloatArray, normal_q: FloatArray, point_q: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Lines in which planes meet: the two-view triangulation, with viewing planes and centres.

    v = n_p x n_q / sin psi,  m = (h_q n_p - h_p n_q) / sin psi  with the offsets h = n . point.

    Args:
        normal_p, normal_q: (*B, 3) unit normals.
        point_p, point_q: (*B, 3) any point of each plane, m.

    Returns:
        (*B, 3) unit directions, (*B, 3) moments, m, and (*B,) sines of the plane angle psi.
        Direction and moment are NaN for parallel planes, also for equal ones.
    """
    across = np.cross(normal_p, normal_q)
    sine = norm(across)
    scale = np.where(sine < PARALLEL_SINE, np.nan, sine)[..., None]
    # Offsets about point_p, where h_p = 0: no large numbers cancel far from the origin.
    h_q = dot(normal_q, point_q - point_p)[..., None]
    direction = across / scale
    moment_about_p = h_q * normal_p / scale
    return direction, shift_origin(direction, moment_about_p, -point_p), sine
