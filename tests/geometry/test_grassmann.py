import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from roel_service.geometry.grassmann import (
    camera_plane_jacobians,
    camera_plane_normal,
    line_basis,
    plane_basis,
    plane_line_angle,
    plane_line_jacobians,
    plane_line_residual,
    principal_angles,
    ray_line_jacobians,
    ray_line_residual,
)
from roel_service.geometry.plucker import (
    moment_from_point,
    nearest_to_origin,
    orthonormal_from_plucker,
    plucker_from_orthonormal,
    retract_orthonormal,
    transform_lines,
)
from roel_service.geometry.se3 import SE3
from roel_service.geometry.vectors import unit

from .strategies import BATCH_SHAPES, central_difference, points, poses, unit_vectors

X, Y, Z = np.eye(3)
SIZES_M = [1.0, 100.0]
scene_sizes = pytest.mark.parametrize("size_m", SIZES_M)
# Step of central differences: its truncation, step^2, is below 1e-10 in scenes of size 1.
STEP = 1e-5


@st.composite
def plane_and_line(draw, shape=(), size_m=1.0):
    """normal, centre, direction, point of the line."""
    normal, direction = draw(unit_vectors(shape)), draw(unit_vectors(shape))
    return normal, draw(points(shape, size_m)), direction, draw(points(shape, size_m))


def projection(basis):
    return basis @ basis.T


def literal_refinement_cost(normal, centre, direction, point):
    """e_Ref of the paper by projection matrices, with the origin shifted to the line."""
    plane = plane_basis(normal, centre - point)
    direction_part = projection(np.eye(3) - np.outer(normal, normal)) @ direction - direction
    homogeneous = np.array([0.0, 0.0, 0.0, 1.0])  # the line's point is the origin; unit already
    position_part = projection(plane) @ homogeneous - homogeneous
    return direction_part @ direction_part + position_part @ position_part


def test_embedded_bases_are_orthonormal_and_hold_their_points():
    rng = np.random.default_rng(1)
    normal, direction = unit(rng.normal(size=(2, 5, 3)))
    point = 10 * rng.normal(size=(5, 3))
    for basis in (line_basis(direction, point), plane_basis(normal, point)):
        gram = np.swapaxes(basis, -1, -2) @ basis
        np.testing.assert_allclose(
            gram, np.broadcast_to(np.eye(basis.shape[-1]), gram.shape), atol=1e-14
        )
        homogeneous = np.concatenate([point, np.ones((5, 1))], axis=-1)[..., None]
        inside = basis @ (np.swapaxes(basis, -1, -2) @ homogeneous)
        np.testing.assert_allclose(inside, homogeneous, atol=1e-13)


def test_basis_does_not_depend_on_the_point_that_names_the_line():
    direction = unit(np.array([1.0, 2.0, 3.0]))
    a = line_basis(direction, np.array([4.0, -5.0, 6.0]))
    b = line_basis(direction, np.array([4.0, -5.0, 6.0]) + 7 * direction)
    np.testing.assert_allclose(principal_angles(a, b), 0.0, atol=1e-14)


@given(plane_and_line(size_m=5.0))
def test_principal_angles_are_those_of_the_singular_values(drawn):
    normal, centre, direction, point = drawn
    line, plane = line_basis(direction, point), plane_basis(normal, centre)
    cosine = np.linalg.svd(line.T @ plane, compute_uv=False)
    # The paper's arccosine, exact to the square root of the resolution.
    np.testing.assert_allclose(
        principal_angles(line, plane), np.arccos(np.clip(cosine, 0, 1)), rtol=0, atol=1e-7
    )


@pytest.mark.parametrize("angle_rad", [0.0, 1e-12, 1e-6, 0.5, np.pi / 2 - 1e-9, np.pi / 2])
def test_principal_angles_are_exact_at_both_ends(angle_rad):
    a = np.eye(4)[:, :1]
    b = np.stack([np.cos(angle_rad) * np.eye(4)[0] + np.sin(angle_rad) * np.eye(4)[1]], axis=-1)
    assert principal_angles(a, b)[0] == pytest.approx(angle_rad, rel=1e-12, abs=1e-16)


@scene_sizes
@given(data=st.data())
def test_closed_form_is_the_only_nonzero_principal_angle(size_m, data):
    normal, centre, direction, point = data.draw(plane_and_line(size_m=size_m))
    line = line_basis(direction, np.zeros(3))
    angles = principal_angles(line, plane_basis(normal, centre - point))
    closed = plane_line_angle(normal, centre, direction, point)
    # Bases of numbers up to 1, rounded a few times.
    np.testing.assert_allclose(angles, [0.0, closed], rtol=0, atol=1e-12)


@scene_sizes
@given(data=st.data())
def test_squared_residual_is_the_literal_cost_of_the_paper(size_m, data):
    drawn = data.draw(plane_and_line(size_m=size_m))
    residual = plane_line_residual(*drawn)
    assert residual @ residual == pytest.approx(literal_refinement_cost(*drawn), abs=1e-12)


@given(plane_and_line(size_m=5.0))
def test_sine_of_the_angle_follows_from_the_residual(drawn):
    slope, offset = plane_line_residual(*drawn)
    # d^2 = r2^2 / (1 - r2^2), hence sin^2 = r1^2 (1 - r2^2) + r2^2.
    expected = slope**2 * (1 - offset**2) + offset**2
    assert np.sin(plane_line_angle(*drawn)) ** 2 == pytest.approx(expected, abs=1e-14)


@scene_sizes
@given(data=st.data())
def test_residual_is_zero_for_a_line_in_the_plane(size_m, data):
    normal, centre, other, _ = data.draw(plane_and_line(size_m=size_m))
    in_plane = np.cross(normal, other)
    assume(np.linalg.norm(in_plane) > 1e-2)
    direction = unit(in_plane)
    point = centre + size_m * np.cross(normal, direction)
    np.testing.assert_allclose(
        plane_line_residual(normal, centre, direction, point), 0.0, atol=1e-12 * size_m
    )
    assert plane_line_angle(normal, centre, direction, point) < 1e-12 * size_m


@pytest.mark.parametrize(
    ("direction", "point", "residual"),
    [
        (X, Z, [0.0, 1 / np.sqrt(2)]),  # parallel to the plane, beside it
        (Z, np.zeros(3), [1.0, 0.0]),  # through the centre, across the plane
        (X, 1e6 * Z, [0.0, 1.0]),  # far away: the second part saturates
    ],
)
def test_residual_is_not_zero_for_a_line_outside_the_plane(direction, point, residual):
    found = plane_line_residual(Z, np.zeros(3), direction, point)
    np.testing.assert_allclose(found, residual, rtol=0, atol=1e-12)


@given(plane_and_line(size_m=5.0))
def test_cost_ignores_the_sign_of_line_and_plane_and_stays_below_two(drawn):
    normal, centre, direction, point = drawn
    residual = plane_line_residual(normal, centre, direction, point)
    flipped = plane_line_residual(normal, centre, -direction, point)
    np.testing.assert_array_equal(flipped, residual * [-1, 1])
    np.testing.assert_array_equal(plane_line_residual(-normal, centre, direction, point), -residual)
    assert residual @ residual < 2.0


@scene_sizes
@given(data=st.data())
def test_residual_is_invariant_to_rigid_motion(size_m, data):
    normal, centre, direction, point = data.draw(plane_and_line(size_m=size_m))
    motion = data.draw(poses(size_m=size_m))
    moved = plane_line_residual(
        motion.rotate(normal), motion @ centre, motion.rotate(direction), motion @ point
    )
    residual = plane_line_residual(normal, centre, direction, point)
    np.testing.assert_allclose(moved, residual, rtol=0, atol=1e-14 * (1 + 10 * size_m))


@given(plane_and_line(), st.sampled_from([1e-3, 100.0]))
def test_scaled_length_makes_the_residual_free_of_the_unit(drawn, scale):
    normal, centre, direction, point = drawn
    plain = plane_line_residual(normal, centre, direction, point)
    scaled = plane_line_residual(normal, scale * centre, direction, scale * point, scale)
    np.testing.assert_allclose(scaled, plain, rtol=0, atol=1e-14)


@st.composite
def line_with_pose(draw, size_m=1.0):
    direction = draw(unit_vectors())
    moment = moment_from_point(draw(points((), size_m)), direction)
    return draw(poses(size_m=size_m)), *orthonormal_from_plucker(direction, moment)


def distance_from_centre_m(pose, direction, moment):
    return np.linalg.norm(moment - np.cross(pose.translation, direction))


def residual_of(T_world_camera, U, phi, normal_camera, along_m, length_scale_m):
    direction, moment = plucker_from_orthonormal(U, phi)
    return plane_line_residual(
        T_world_camera.rotate(normal_camera),
        T_world_camera.translation,
        direction,
        nearest_to_origin(direction, moment) + along_m * direction,
        length_scale_m,
    )


def assert_plane_line_jacobians(T_world_camera, U, phi, normal_camera, along_m, scale_m, step, tol):
    by_line, by_pose = plane_line_jacobians(
        T_world_camera.rotate(normal_camera), T_world_camera.translation, U, phi, along_m, scale_m
    )
    settings = (normal_camera, along_m, scale_m)
    numeric_line = central_difference(
        lambda delta: residual_of(T_world_camera, *retract_orthonormal(U, phi, delta), *settings),
        4,
        step,
    )
    numeric_pose = central_difference(
        lambda delta: residual_of(T_world_camera.retract(delta), U, phi, *settings), 6, step
    )
    np.testing.assert_allclose(by_line, numeric_line, rtol=0, atol=tol)
    np.testing.assert_allclose(by_pose, numeric_pose, rtol=0, atol=tol)


@given(line_with_pose(), unit_vectors(), st.floats(-2, 2))
def test_plane_line_jacobians_agree_with_central_differences(drawn, normal_camera, along_m):
    # Third derivatives, mostly of tan at |m| < 1.8 m, stay below 1e3; rounding is 1e-16 / STEP.
    assert_plane_line_jacobians(*drawn, normal_camera, along_m, 1.0, STEP, 1e-7)


@given(line_with_pose(size_m=100.0), unit_vectors(), st.floats(-200, 200))
def test_plane_line_jacobians_hold_in_a_large_scene(drawn, normal_camera, along_m):
    # With depth as the scale the residual is an angle. (1 + |m|^2) reaches 3e4 m per rad, hence
    # the small step: truncation (3e4)^2 step^2, rounding 1e-14 / step.
    assert_plane_line_jacobians(*drawn, normal_camera, along_m, 100.0, 1e-8, 1e-4)


@pytest.mark.parametrize("phi", [0.0, 1e-9, -1e-9])
@pytest.mark.parametrize("normal_camera", [X, Y, Z])
def test_plane_line_jacobians_hold_for_lines_through_the_origin(phi, normal_camera):
    U, _ = orthonormal_from_plucker(X, np.zeros(3))
    pose = SE3(rotation=np.eye(3), translation=np.array([0.3, -0.2, 1.0]))
    assert_plane_line_jacobians(pose, U, np.asarray(phi), normal_camera, 0.5, 1.0, STEP, 1e-9)


def test_plane_line_jacobians_hold_where_the_residual_vanishes():
    U, phi = orthonormal_from_plucker(X, moment_from_point(2 * Z, X))
    assert_plane_line_jacobians(SE3.identity(), U, phi, Y, 0.0, 1.0, STEP, 1e-8)


@pytest.mark.parametrize("shape", BATCH_SHAPES)
def test_batch_axes_lead_in_every_function(shape):
    rng = np.random.default_rng(3)
    normal, direction, ray = unit(rng.normal(size=(3, *shape, 3)))
    centre, point = rng.normal(size=(2, *shape, 3))
    U, phi = orthonormal_from_plucker(direction, moment_from_point(point, direction))
    pose = SE3(rotation=np.broadcast_to(np.eye(3), (*shape, 3, 3)), translation=centre)
    assert plane_line_residual(normal, centre, direction, point).shape == (*shape, 2)
    assert plane_line_angle(normal, centre, direction, point).shape == shape
    by_line, by_pose = plane_line_jacobians(normal, centre, U, phi, 0.1)
    assert (by_line.shape, by_pose.shape) == ((*shape, 2, 4), (*shape, 2, 6))
    by_line, by_pose = ray_line_jacobians(ray, pose, U, phi)
    assert (by_line.shape, by_pose.shape) == ((*shape, 4), (*shape, 6))
    if shape:
        first = (0,) * len(shape)
        one_line, one_pose = ray_line_jacobians(ray[first], pose[first], U[first], phi[first])
        np.testing.assert_allclose(by_line[first], one_line, rtol=1e-13)
        np.testing.assert_allclose(by_pose[first], one_pose, rtol=1e-13)


@scene_sizes
@given(data=st.data())
def test_event_residual_is_zero_exactly_for_rays_that_meet_the_line(size_m, data):
    pose, U, phi = data.draw(line_with_pose(size_m))
    direction, moment = plucker_from_orthonormal(U, phi)
    normal = camera_plane_normal(pose, direction, moment)
    assume(distance_from_centre_m(pose, direction, moment) > 1e-2 * size_m)
    along_m = size_m * np.linspace(-3, 3, 5)[:, None]
    on_line = nearest_to_origin(direction, moment) + along_m * direction
    rays = unit(pose.inverse() @ on_line)
    np.testing.assert_allclose(ray_line_residual(rays, pose, direction, moment), 0.0, atol=1e-11)
    assert ray_line_residual(normal, pose, direction, moment) == pytest.approx(1.0, abs=1e-14)


@given(line_with_pose(), unit_vectors(), poses(size_m=2.0))
def test_event_residual_ignores_rigid_motion_and_follows_the_sign_of_the_line(drawn, ray, motion):
    pose, U, phi = drawn
    direction, moment = plucker_from_orthonormal(U, phi)
    assume(distance_from_centre_m(pose, direction, moment) > 1e-2)
    residual = ray_line_residual(ray, pose, direction, moment)
    moved = ray_line_residual(ray, motion @ pose, *transform_lines(motion, direction, moment))
    # Moments of a few m, rounded at 1e-15, over the smallest distance of the line.
    np.testing.assert_allclose(moved, residual, rtol=0, atol=1e-12)
    mirrored = ray_line_residual(ray, pose, -direction, -moment)
    np.testing.assert_allclose(mirrored, -residual, rtol=0, atol=1e-12)


def assert_ray_line_jacobians(pose, U, phi, ray, step, tol):
    by_line, by_pose = ray_line_jacobians(ray, pose, U, phi)

    def residual(moved_pose, moved_U, moved_phi):
        return ray_line_residual(ray, moved_pose, *plucker_from_orthonormal(moved_U, moved_phi))

    numeric_line = central_difference(
        lambda delta: residual(pose, *retract_orthonormal(U, phi, delta)), 4, step
    )
    numeric_pose = central_difference(lambda delta: residual(pose.retract(delta), U, phi), 6, step)
    np.testing.assert_allclose(by_line, numeric_line, rtol=0, atol=tol)
    np.testing.assert_allclose(by_pose, numeric_pose, rtol=0, atol=tol)


@given(line_with_pose(), unit_vectors())
def test_ray_line_jacobians_agree_with_central_differences(drawn, ray):
    pose, U, phi = drawn
    direction, moment = plucker_from_orthonormal(U, phi)
    # The derivative grows with 1/distance, its truncation error with the cube of that.
    assume(distance_from_centre_m(pose, direction, moment) > 0.3)
    # (1 + |m|^2)/distance < 15 per rad; truncation (15 STEP)^2.
    assert_ray_line_jacobians(pose, U, phi, ray, STEP, 1e-6)


@pytest.mark.parametrize("distance_m", [1e-3, 1.0, 100.0])
def test_ray_line_jacobians_hold_near_and_far_from_the_centre(distance_m):
    U, phi = orthonormal_from_plucker(X, moment_from_point(2 * Y, X))
    pose = SE3(rotation=np.eye(3), translation=2 * Y - distance_m * Z)
    ray = unit(np.array([0.3, 0.2, 1.0]))
    # Derivatives of 5/distance per rad: steps of 1e-4 distances leave (5e-4)^2 of them.
    step = 1e-4 * min(distance_m, 0.1)
    assert_ray_line_jacobians(pose, U, phi, ray, step, 1e-5 * max(1.0, 1 / distance_m))


def test_ray_line_jacobians_hold_for_lines_through_the_world_origin():
    U, phi = orthonormal_from_plucker(X, np.zeros(3))
    pose = SE3(rotation=np.eye(3), translation=np.array([0.1, 0.2, -1.0]))
    assert_ray_line_jacobians(pose, U, phi, unit(np.array([0.1, -0.3, 1.0])), STEP, 1e-8)


def test_line_through_the_camera_centre_is_nan():
    pose = SE3(rotation=np.eye(3), translation=3 * X)
    U, phi = orthonormal_from_plucker(X, np.zeros(3))
    assert np.isnan(ray_line_residual(Z, pose, X, np.zeros(3)))
    by_line, by_pose = camera_plane_jacobians(pose, U, phi)
    assert np.isnan(by_line).any()
    assert np.isnan(by_pose).any()


@given(line_with_pose())
def test_compressed_events_cost_what_they_cost_one_by_one(drawn):
    pose, U, phi = drawn
    direction, moment = plucker_from_orthonormal(U, phi)
    assume(distance_from_centre_m(pose, direction, moment) > 1e-2)
    rays = unit(np.random.default_rng(5).normal(size=(30, 3)))
    normal = camera_plane_normal(pose, direction, moment)
    residual = ray_line_residual(rays, pose[None], direction, moment)
    assert normal @ (rays.T @ rays) @ normal == pytest.approx(residual @ residual, rel=1e-12)
