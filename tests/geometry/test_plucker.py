import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from roel_service.geometry.plucker import (
    PARALLEL_SINE,
    arc_length,
    closest_points,
    endpoints_from_plucker,
    intersect_line_plane,
    intersect_planes,
    moment_from_point,
    nearest_to_origin,
    nearest_to_point,
    nearest_to_ray,
    orthonormal_from_plucker,
    plucker_from_endpoints,
    plucker_from_orthonormal,
    plucker_jacobians,
    retract_orthonormal,
    shift_origin,
    transform_lines,
)
from roel_service.geometry.vectors import unit

from .strategies import (
    BATCH_SHAPES,
    arrays,
    assert_same_lines,
    central_difference,
    points,
    poses,
    segments,
    unit_vectors,
)

# m: coordinates up to 10 m and segments of 0.1 m and more, so that a rounding of 1e-15 m in an end
# turns the direction by 1e-14 rad and the moment by 1e-13 m.
ATOL = 1e-12
SIZES_M = [1.0, 100.0]

any_batch = st.sampled_from(BATCH_SHAPES)


@st.composite
def lines(draw, shape=(), size_m=10.0):
    direction = draw(unit_vectors(shape))
    return direction, moment_from_point(draw(points(shape, size_m)), direction)


X, Y, Z = np.eye(3)
ORIGIN = np.zeros(3)


@given(any_batch.flatmap(segments))
def test_endpoints_return_from_pluecker_coordinates(segment):
    direction, moment = plucker_from_endpoints(segment)
    interval_m = arc_length(direction[..., None, :], segment)
    back = endpoints_from_plucker(direction, moment, interval_m)
    np.testing.assert_allclose(back, segment, rtol=0, atol=1e-11)


@given(any_batch.flatmap(segments))
def test_moment_is_normal_to_the_unit_direction(segment):
    direction, moment = plucker_from_endpoints(segment)
    np.testing.assert_allclose(np.linalg.norm(direction, axis=-1), 1.0, rtol=1e-15)
    np.testing.assert_allclose(np.vecdot(direction, moment), 0.0, atol=1e-13)


@given(segments())
def test_swapped_ends_give_the_same_line(segment):
    line = plucker_from_endpoints(segment)
    assert_same_lines(*line, *plucker_from_endpoints(segment[::-1]), atol=ATOL)


def test_equal_ends_have_no_line():
    direction, moment = plucker_from_endpoints(np.ones((2, 3)))
    assert np.isnan(direction).all()
    assert np.isnan(moment).all()


@given(any_batch.flatmap(lines))
def test_orthonormal_form_is_a_rotation_and_round_trips(line):
    direction, moment = line
    U, phi = orthonormal_from_plucker(direction, moment)
    identity = np.broadcast_to(np.eye(3), U.shape)
    np.testing.assert_allclose(np.swapaxes(U, -1, -2) @ U, identity, rtol=0, atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(U), 1.0, rtol=1e-14)
    back_direction, back_moment = plucker_from_orthonormal(U, phi)
    np.testing.assert_allclose(back_direction, direction, rtol=0, atol=1e-14)
    # tan(atan(m)) multiplies a rounding of the angle by 1 + m^2, below 400 here.
    np.testing.assert_allclose(back_moment, moment, rtol=0, atol=1e-12)


@given(unit_vectors((4,)))
def test_line_through_origin_keeps_unit_direction(direction):
    U, phi = orthonormal_from_plucker(direction, np.zeros((4, 3)))
    np.testing.assert_array_equal(phi, 0.0)
    np.testing.assert_allclose(np.linalg.det(U), 1.0, rtol=1e-14)
    back_direction, back_moment = plucker_from_orthonormal(U, phi)
    np.testing.assert_array_equal(back_direction, direction)
    np.testing.assert_array_equal(back_moment, 0.0)


@pytest.mark.parametrize("length_m", [1e-149, 1e-15, 1e-7, 1.0, 1e3])
def test_orthonormal_form_holds_for_any_length_of_the_moment(length_m):
    U, phi = orthonormal_from_plucker(X, length_m * Y)
    np.testing.assert_allclose(U, np.eye(3), rtol=0, atol=1e-15)
    np.testing.assert_allclose(np.tan(phi), length_m, rtol=1e-12)


@pytest.mark.parametrize("length_m", [1e-150, 1e-160, 1e-300, 5e-324])
def test_moment_whose_square_underflows_counts_as_zero(length_m):
    U, phi = orthonormal_from_plucker(unit(X + Z), length_m * Y)
    assert phi == 0.0
    np.testing.assert_allclose(U.T @ U, np.eye(3), atol=1e-15)


@pytest.mark.parametrize("noise", [X, -X, X + 0.3 * Y])
def test_moment_along_the_direction_counts_as_rounding(noise):
    U, phi = orthonormal_from_plucker(X, 1e-16 * noise)
    assert phi == 0.0
    np.testing.assert_allclose(U.T @ U, np.eye(3), atol=1e-15)
    np.testing.assert_array_equal(U[:, 0], X)


@given(lines(), arrays(4, -1e-9, 1e-9))
def test_small_steps_follow_the_jacobians(line, delta):
    U, phi = orthonormal_from_plucker(*line)
    direction, moment = plucker_from_orthonormal(U, phi)
    moved_direction, moved_moment = plucker_from_orthonormal(*retract_orthonormal(U, phi, delta))
    by_direction, by_moment = plucker_jacobians(U, phi)
    # Second order: 1e-18 times derivatives up to 2 (1 + 300)^1.5 m.
    np.testing.assert_allclose(moved_direction - direction, by_direction @ delta, atol=1e-15)
    np.testing.assert_allclose(moved_moment - moment, by_moment @ delta, rtol=0, atol=2e-13)


@pytest.mark.parametrize("phi", [0.0, 1e-9, -1e-9, 0.3, -0.7, 1.5])
def test_jacobians_agree_with_central_differences(phi):
    U, _ = orthonormal_from_plucker(np.array([0.6, 0.0, 0.8]), np.array([0.0, 2.0, 0.0]))
    phi = np.asarray(phi)

    def moved(delta):
        return np.concatenate(plucker_from_orthonormal(*retract_orthonormal(U, phi, delta)))

    numeric = central_difference(moved, 4, 1e-5)
    # Third derivative of tan, 6 (1 + tan^2)^2 < 3e5 at 1.5 rad, times 1e-10 / 6.
    np.testing.assert_allclose(
        np.concatenate(plucker_jacobians(U, phi)), numeric, rtol=0, atol=1e-5
    )


def test_a_step_may_carry_a_line_across_the_origin():
    U, phi = orthonormal_from_plucker(X, 0.1 * Y)
    direction, moment = plucker_from_orthonormal(
        *retract_orthonormal(U, phi, np.array([0, 0, 0, -0.2]))
    )
    np.testing.assert_array_equal(direction, X)
    np.testing.assert_allclose(moment, np.tan(np.arctan(0.1) - 0.2) * Y, rtol=1e-14)
    assert moment[1] < 0


@pytest.mark.parametrize("size_m", SIZES_M)
@given(data=st.data())
def test_transformed_line_passes_the_transformed_points(size_m, data):
    T_b_a = data.draw(poses(size_m=size_m))
    segment = data.draw(segments(size=size_m, min_length=0.1 * size_m))
    moved = transform_lines(T_b_a, *plucker_from_endpoints(segment))
    expected = plucker_from_endpoints(T_b_a @ segment)
    assert_same_lines(*moved, *expected, atol=1e-12 * size_m)


@given(lines(), points())
def test_shifted_moment_is_that_of_the_moved_world(line, origin):
    direction, moment = line
    point = nearest_to_origin(direction, moment)
    expected = moment_from_point(point - origin, direction)
    np.testing.assert_allclose(shift_origin(direction, moment, origin), expected, rtol=0, atol=ATOL)


@given(lines((3,)), points((3,)))
def test_nearest_point_is_on_the_line_and_at_right_angles(line, point):
    direction, moment = line
    nearest = nearest_to_point(direction, moment, point)
    np.testing.assert_allclose(moment_from_point(nearest, direction), moment, rtol=0, atol=ATOL)
    np.testing.assert_allclose(np.vecdot(point - nearest, direction), 0.0, atol=ATOL)
    foot = nearest_to_point(direction, moment, np.zeros(3))
    np.testing.assert_allclose(foot, nearest_to_origin(direction, moment), rtol=0, atol=ATOL)


@pytest.mark.parametrize("size_m", SIZES_M)
@given(data=st.data())
def test_closest_points_are_joined_by_the_common_normal(size_m, data):
    line_1, line_2 = data.draw(lines(size_m=size_m)), data.draw(lines(size_m=size_m))
    sine = np.linalg.norm(np.cross(line_1[0], line_2[0]))
    assume(sine > 1e-2)
    point_1, point_2 = closest_points(*line_1, *line_2)
    joint = point_2 - point_1
    atol = 1e-12 * size_m / sine**2
    np.testing.assert_allclose([joint @ line_1[0], joint @ line_2[0]], 0.0, atol=atol)
    for point, (direction, moment) in ((point_1, line_1), (point_2, line_2)):
        np.testing.assert_allclose(moment_from_point(point, direction), moment, rtol=0, atol=atol)


def test_lines_that_meet_share_their_closest_point():
    meeting = np.array([1.0, 2.0, 3.0])
    point_1, point_2 = closest_points(
        X, moment_from_point(meeting, X), Y, moment_from_point(meeting, Y)
    )
    np.testing.assert_allclose([point_1, point_2], [meeting, meeting], atol=1e-15)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_parallel_lines_answer_the_foot_of_the_first(sign):
    point_1, point_2 = closest_points(
        X, moment_from_point(Y, X), sign * X, moment_from_point(3 * Z, sign * X)
    )
    np.testing.assert_array_equal(point_1, Y)
    np.testing.assert_array_equal(point_2, 3 * Z)


def test_nearest_to_ray_ahead_is_that_of_the_two_lines():
    line = (X, moment_from_point(5 * Z + Y, X))
    ray = np.array([0.6, 0.0, 0.8])
    expected, _ = closest_points(*line, ray, moment_from_point(ORIGIN, ray))
    np.testing.assert_allclose(nearest_to_ray(*line, ORIGIN, ray), expected, atol=1e-15)
    np.testing.assert_allclose(expected, [3.75, 1.0, 5.0], atol=1e-14)


@pytest.mark.parametrize("ray", [np.array([0.6, 0.0, -0.8]), X, -X])
def test_ray_that_leaves_or_never_meets_the_line_answers_nearest_to_its_origin(ray):
    line = (X, moment_from_point(5 * Z, X))
    origin = np.array([2.0, 1.0, 0.0])
    np.testing.assert_allclose(nearest_to_ray(*line, origin, ray), [2, 0, 5], atol=1e-14)


@pytest.mark.parametrize("size_m", SIZES_M)
@given(data=st.data())
def test_cut_of_line_and_plane_lies_in_both(size_m, data):
    direction, moment = data.draw(lines(size_m=size_m))
    normal, point = data.draw(unit_vectors()), data.draw(points((), size_m))
    slope = abs(normal @ direction)
    assume(slope > 1e-2)
    cut = intersect_line_plane(direction, moment, normal, point)
    atol = 1e-12 * size_m / slope
    assert normal @ (cut - point) == pytest.approx(0.0, abs=atol)
    np.testing.assert_allclose(moment_from_point(cut, direction), moment, rtol=0, atol=atol)


@pytest.mark.parametrize("height_m", [0.0, 1.0])
def test_line_parallel_to_a_plane_has_no_cut(height_m):
    cut = intersect_line_plane(X, moment_from_point(height_m * Z, X), Z, ORIGIN)
    assert np.isnan(cut).all()


@pytest.mark.parametrize("size_m", SIZES_M)
@pytest.mark.parametrize("offset_m", [0.0, 1e4])
def test_two_viewing_planes_give_back_their_line(size_m, offset_m):
    rng = np.random.default_rng(7)
    centre_p, centre_q, a, b = offset_m + size_m * rng.normal(size=(4, 50, 3))
    segment = np.stack([a, b], axis=-2)
    normal_p, normal_q = (np.cross(a - centre, b - centre) for centre in (centre_p, centre_q))
    normal_p /= np.linalg.norm(normal_p, axis=-1, keepdims=True)
    normal_q /= np.linalg.norm(normal_q, axis=-1, keepdims=True)
    direction, moment, sine = intersect_planes(normal_p, centre_p, normal_q, centre_q)
    np.testing.assert_allclose(sine, np.linalg.norm(np.cross(normal_p, normal_q), axis=-1))
    assert sine.min() > 1e-3
    # Rounding of the ends, 1e-16 of their offset, over the smallest plane angle and distance.
    atol = 1e-10 * (size_m + offset_m) / sine.min() * 1e-2
    distance_m = np.linalg.norm(
        segment - nearest_to_point(direction[:, None], moment[:, None], segment), axis=-1
    )
    assert distance_m.max() < atol


@pytest.mark.parametrize("tilt_rad", [0.0, 0.1 * PARALLEL_SINE])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_parallel_planes_have_no_line_and_sine_zero(tilt_rad, sign):
    tilted = sign * np.array([tilt_rad, 0.0, 1.0])
    direction, moment, sine = intersect_planes(Z, ORIGIN, tilted, 2 * Z)
    assert np.isnan(direction).all()
    assert np.isnan(moment).all()
    assert sine == tilt_rad
