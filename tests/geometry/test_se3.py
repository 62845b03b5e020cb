import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from roel_service.geometry import se3
from roel_service.geometry.se3 import SE3, rotation_angle, rotation_from_vector, skew

from .strategies import BATCH_SHAPES, arrays, points, poses

# m and rad: a few roundings of numbers up to 30.
ATOL = 1e-12


def assert_same_transform(a, b, atol=ATOL):
    np.testing.assert_allclose(a.matrix(), b.matrix(), rtol=0, atol=atol)


def batches(*strategies):
    """Tuples over one common batch shape."""
    return st.sampled_from(BATCH_SHAPES).flatmap(
        lambda shape: st.tuples(*(strategy(shape) for strategy in strategies))
    )


@given(batches(poses, poses, poses))
def test_composition_is_associative(transforms):
    a, b, c = transforms
    assert_same_transform((a @ b) @ c, a @ (b @ c), atol=1e-11)


@given(batches(poses))
def test_inverse_composes_to_the_identity_on_both_sides(transforms):
    (a,) = transforms
    identity = np.broadcast_to(np.eye(4), (*a.batch_shape, 4, 4))
    np.testing.assert_allclose((a @ a.inverse()).matrix(), identity, rtol=0, atol=ATOL)
    np.testing.assert_allclose((a.inverse() @ a).matrix(), identity, rtol=0, atol=ATOL)


@given(batches(poses, poses, points))
def test_composition_acts_on_points_one_after_the_other(drawn):
    a, b, p = drawn
    np.testing.assert_allclose((a @ b) @ p, a @ (b @ p), rtol=0, atol=1e-11)


@given(batches(poses, points))
def test_matrix_acts_as_the_transform_does(drawn):
    a, p = drawn
    homogeneous = np.concatenate([p, np.ones((*p.shape[:-1], 1))], axis=-1)
    moved = np.einsum("...ij,...j->...i", a.matrix(), homogeneous)
    np.testing.assert_allclose(moved[..., :3], a @ p, rtol=0, atol=ATOL)
    assert_same_transform(SE3.from_matrix(a.matrix()), a, atol=0)


@given(batches(poses))
def test_quaternion_round_trip_keeps_the_pose(transforms):
    (a,) = transforms
    quaternion = a.quaternion_xyzw()
    assert quaternion.shape == (*a.batch_shape, 4)
    assert (quaternion[..., 3] >= 0).all()
    assert_same_transform(SE3.from_quaternion(quaternion, a.translation), a)


@given(batches(poses, poses))
def test_retract_undoes_local(transforms):
    a, b = transforms
    # Near a half turn the rotation vector is known to the square root of the resolution.
    assert_same_transform(a.retract(a.local(b)), b, atol=1e-7)


@given(batches(poses, lambda shape: arrays((*shape, 6))))
def test_local_undoes_retract(drawn):
    a, tangent = drawn
    np.testing.assert_allclose(a.local(a.retract(tangent)), tangent, rtol=0, atol=1e-11)


@given(arrays(6, -1e-7, 1e-7))
def test_retract_near_the_identity_is_linear(tangent):
    stepped = SE3.identity().retract(tangent)
    # The second-order term is 1e-14 / 2 for each pair of axes.
    linear = np.eye(3) + skew(tangent[:3])
    np.testing.assert_allclose(stepped.rotation, linear, rtol=0, atol=4e-14)
    np.testing.assert_allclose(SE3.identity().local(stepped), tangent, rtol=0, atol=1e-15)


def test_retract_turns_about_the_axes_of_the_target_frame():
    quarter_turn_about_x = rotation_from_vector(np.array([np.pi / 2, 0, 0]))
    pose = SE3(rotation=quarter_turn_about_x, translation=np.array([1.0, 2.0, 3.0]))
    stepped = pose.retract(np.array([0, 0, np.pi / 2, 0.1, 0, 0]))
    # y of the source points to z of the target and is not moved by a turn about z.
    np.testing.assert_allclose(stepped.rotate(np.array([0.0, 1, 0])), [0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(stepped.translation, [1.1, 2, 3], atol=1e-15)


@given(arrays((3,), -np.pi, np.pi))
def test_exponential_is_a_rotation_by_the_length_of_its_vector(vector):
    rotation = rotation_from_vector(vector)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=1e-14)
    assert np.linalg.det(rotation) == pytest.approx(1.0, abs=1e-14)
    angle = np.linalg.norm(vector)
    expected = min(angle, 2 * np.pi - angle) if angle <= 2 * np.pi else angle - 2 * np.pi
    # The arcsine is flat at pi: half the digits remain there.
    assert rotation_angle(rotation) == pytest.approx(expected, abs=1e-7)


@pytest.mark.parametrize("angle_rad", [1e-12, 1e-8, 1e-5, 0.99e-4, 1.01e-4, 1e-3])
def test_small_angles_are_measured_to_full_precision(angle_rad):
    rotation = rotation_from_vector(np.array([0.0, angle_rad, 0.0]))
    # An entry of the matrix near 1 is rounded by 1e-16, one near the angle far less.
    assert rotation_angle(rotation) == pytest.approx(angle_rad, rel=1e-9, abs=1e-16)
    np.testing.assert_allclose(rotation[0, 2], np.sin(angle_rad), rtol=1e-15)


def test_series_and_closed_form_meet_at_the_switch():
    axis = np.array([1.0, 2.0, -2.0]) / 3.0
    below, above = (
        rotation_from_vector(axis * se3.SMALL_ANGLE_RAD * k) for k in (1 - 1e-9, 1 + 1e-9)
    )
    np.testing.assert_allclose(below, above, rtol=0, atol=1e-12)


@given(points(), points())
def test_skew_matrix_is_the_cross_product(a, b):
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b), rtol=0, atol=1e-13)


@given(batches(poses, poses))
def test_interpolation_starts_and_ends_at_its_arguments(transforms):
    a, b = transforms
    zero, one = np.zeros(a.batch_shape), np.ones(a.batch_shape)
    assert_same_transform(se3.interpolate(a, b, zero), a)
    assert_same_transform(se3.interpolate(a, b, one), b, atol=1e-7)


@given(poses(max_angle_rad=1.5), poses(max_angle_rad=1.5), st.floats(0, 1))
def test_interpolation_turns_at_constant_speed(a, b, fraction):
    between = se3.interpolate(a, b, np.asarray(fraction))
    whole = rotation_angle(a.rotation.T @ b.rotation)
    np.testing.assert_allclose(
        rotation_angle(a.rotation.T @ between.rotation), fraction * whole, rtol=0, atol=1e-7
    )
    np.testing.assert_allclose(
        between.translation,
        (1 - fraction) * a.translation + fraction * b.translation,
        rtol=0,
        atol=1e-14 * 20,
    )


def test_indexing_picks_from_the_batch():
    batch = SE3(rotation=np.tile(np.eye(3), (4, 1, 1)), translation=np.arange(12.0).reshape(4, 3))
    assert len(batch) == 4
    np.testing.assert_array_equal(batch[1:3].translation, [[3, 4, 5], [6, 7, 8]])
    assert batch[2].batch_shape == ()


@pytest.mark.parametrize(
    ("rotation", "translation", "named"),
    [
        (np.eye(2), np.zeros(3), "rotation"),
        (np.eye(3), np.zeros(2), "translation"),
        (np.full((3, 3), np.nan), np.zeros(3), "rotation"),
        (np.eye(3), np.array([0, np.inf, 0]), "translation"),
        (np.eye(3), np.zeros((2, 3)), "rotation"),
    ],
)
def test_constructor_refuses_wrong_shapes_and_values(rotation, translation, named):
    with pytest.raises(ValueError, match=named):
        SE3(rotation=rotation, translation=translation)


def test_arrays_of_a_transform_are_read_only():
    with pytest.raises(ValueError, match="read-only"):
        SE3.identity().translation[0] = 1.0


@given(arrays((3,), -np.pi, np.pi), st.integers(0, 2))
def test_jacobian_of_a_rotation_vector_is_its_derivative(vector, axis):
    step = 1e-6 * np.eye(3)[axis]
    before, after = rotation_from_vector(vector - step), rotation_from_vector(vector + step)
    turned = se3.vector_from_rotation(after @ before.T) / 2e-6
    # Central differences: 1e-12 of the third derivative, and rounding over the step.
    np.testing.assert_allclose(
        turned, se3.rotation_vector_jacobian(vector)[:, axis], rtol=0, atol=1e-8
    )


def test_jacobian_of_a_rotation_vector_is_continuous_where_its_series_begins():
    below, above = np.array([[0.99e-4, 0, 0], [1.01e-4, 0, 0]])
    difference = se3.rotation_vector_jacobian(above) - se3.rotation_vector_jacobian(below)
    np.testing.assert_allclose(difference, 0.5 * skew(above - below), rtol=0, atol=1e-9)
