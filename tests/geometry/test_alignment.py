import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from roel_service.geometry.alignment import align_poses
from roel_service.geometry.se3 import SE3, rotation_from_vector

vectors = st.tuples(*[st.floats(-3, 3)] * 3).map(np.array)


def poses(positions, seed=0):
    turns = np.random.default_rng(seed).normal(size=(len(positions), 3))
    return SE3(rotation=rotation_from_vector(turns), translation=positions)


@given(vectors, vectors, st.integers(1, 20))
def test_moved_poses_come_back(turn, shift, count):
    source = poses(np.random.default_rng(count).normal(size=(count, 3)))
    T = SE3(rotation=rotation_from_vector(turn), translation=shift)
    # Singular values within 1e-6 of each other cost half of float64's digits.
    np.testing.assert_allclose(align_poses(source, T @ source).matrix(), T.matrix(), atol=1e-6)


def test_a_straight_path_is_aligned_by_its_orientations():
    source = poses(np.linspace(0.0, 1.0, 10)[:, None] * [1.0, 2.0, 3.0])
    T = SE3(rotation=rotation_from_vector(np.array([0.5, -0.2, 0.1])), translation=np.ones(3))
    np.testing.assert_allclose(align_poses(source, T @ source).matrix(), T.matrix(), atol=1e-8)


def test_positions_count_before_orientations():
    source = poses(np.random.default_rng(0).normal(size=(50, 3)))
    turned = SE3(
        rotation=rotation_from_vector(np.array([0.0, 0.0, 0.3])) @ source.rotation,
        translation=source.translation,
    )
    # The orientations' share is a millionth.
    np.testing.assert_allclose(align_poses(source, turned).matrix(), np.eye(4), atol=1e-5)


def test_positions_and_orientations_meet_where_their_squares_are_least():
    source = poses(np.random.default_rng(0).normal(size=(50, 3)))
    spin = SE3(rotation=rotation_from_vector(np.array([0.0, 0.0, 0.01])), translation=np.zeros(3))
    turned = SE3(rotation=spin.rotation @ source.rotation, translation=source.translation)
    offsets = source.translation - source.translation.mean(axis=0)
    reach2_m2 = np.mean(offsets[:, 0] ** 2 + offsets[:, 1] ** 2)
    # Orientations ask for the whole turn, positions for none, about an axis through their middle.
    rotation = align_poses(source, turned, lever_m=2.0).rotation
    expected_rad = 0.01 * 2.0**2 / (2.0**2 + reach2_m2)
    np.testing.assert_allclose(rotation[1, 0], expected_rad, rtol=0.02)
