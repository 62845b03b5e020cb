import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from roel_service.errors import TrajectoryError
from roel_service.evaluation.poses import (
    rotation_errors_rad,
    success_rate,
    trajectory_errors,
    translation_errors_m,
)
from roel_service.geometry.alignment import align_points
from roel_service.geometry.se3 import SE3, rotation_from_vector
from roel_service.scene.trajectory import Trajectory

ATOL = 1e-9  # m and rad, float64 with numbers up to 100

vectors = st.tuples(*[st.floats(-3, 3)] * 3).map(np.array)


def poses(count, seed=0):
    rng = np.random.default_rng(seed)
    return SE3(
        rotation=rotation_from_vector(rng.normal(size=(count, 3))),
        translation=rng.normal(size=(count, 3)),
    )


def trajectory(T_world_camera, start_us=0):
    t_us = start_us + 10_000 * np.arange(len(T_world_camera))
    return Trajectory(t_us=t_us, T_world_camera=T_world_camera)


def transformed(T_b_a, T_a_camera, scale=1.0):
    """The same motion in frame b, whose lengths are `scale` times as large."""
    return SE3(
        rotation=T_b_a.rotation @ T_a_camera.rotation,
        translation=scale * T_b_a.rotate(T_a_camera.translation) + T_b_a.translation,
    )


@given(vectors)
def test_errors_are_angle_and_distance(vector):
    truth = poses(4)
    turned = SE3(
        rotation=truth.rotation @ rotation_from_vector(vector),
        translation=truth.translation + vector,
    )
    length = np.linalg.norm(vector)
    angle = min(length % (2 * np.pi), 2 * np.pi - length % (2 * np.pi))
    np.testing.assert_allclose(translation_errors_m(turned, truth), length, atol=ATOL)
    # Near half a turn the arcsine loses half the digits.
    np.testing.assert_allclose(rotation_errors_rad(turned, truth), angle, atol=1e-7)


def test_success_needs_both_bounds():
    truth = poses(4)
    shifts = np.array([[0, 0, 0], [0.2, 0, 0], [0, 0, 0], [0.2, 0, 0]])
    turns = np.radians([[0, 0, 0], [0, 0, 0], [10, 0, 0], [10, 0, 0]])
    estimate = SE3(
        rotation=truth.rotation @ rotation_from_vector(turns),
        translation=truth.translation + shifts,
    )
    assert success_rate(estimate, truth, 0.1, 5.0) == 0.25
    assert success_rate(estimate, truth, 0.3, 5.0) == 0.5
    assert success_rate(estimate, truth, 0.3, 15.0) == 1.0
    assert success_rate(estimate[:0], truth[:0], 0.1, 5.0) == 0.0


@given(vectors, vectors, st.floats(0.1, 10), st.integers(3, 20))
def test_alignment_recovers_a_similarity(turn, shift, scale, count):
    source = np.random.default_rng(count).normal(size=(count, 3))
    truth = SE3(rotation=rotation_from_vector(turn), translation=shift)
    target = scale * truth.rotate(source) + shift
    found = align_points(source, target, with_scale=True)
    assert found.scale == pytest.approx(scale, abs=ATOL)
    np.testing.assert_allclose(found.apply(source), target, atol=ATOL)
    np.testing.assert_allclose(found.T_target_source.matrix(), truth.matrix(), atol=1e-7)


def test_alignment_without_scale_keeps_lengths():
    source = np.random.default_rng(0).normal(size=(10, 3))
    found = align_points(source, 2.0 * source, with_scale=False)
    assert found.scale == 1.0
    np.testing.assert_allclose(found.T_target_source.rotation, np.eye(3), atol=ATOL)


def test_mirrored_points_are_aligned_by_a_rotation():
    source = np.random.default_rng(0).normal(size=(10, 3))
    found = align_points(source, source * [1, 1, -1], with_scale=True)
    assert np.linalg.det(found.T_target_source.rotation) == pytest.approx(1.0)


@pytest.mark.parametrize("source", [np.zeros((1, 3)), np.ones((4, 3)), np.eye(3)[[0, 0, 1]]])
def test_points_without_extent_are_aligned(source):
    target = source + np.array([1.0, 2.0, 3.0])
    for with_scale in (False, True):
        found = align_points(source, target, with_scale=with_scale)
        np.testing.assert_allclose(found.apply(source), target, atol=ATOL)


def test_trajectory_in_another_frame_has_no_error():
    truth = poses(50)
    estimate = transformed(poses(1, seed=5)[0], truth)
    errors = trajectory_errors(trajectory(estimate), trajectory(truth))
    assert errors.pose_count == 50
    assert errors.ate_max_m == pytest.approx(0, abs=ATOL)
    assert errors.rotation_rms_deg == pytest.approx(0, abs=1e-6)


def test_scale_is_an_error_unless_it_is_free():
    truth = poses(50)
    estimate = trajectory(transformed(poses(1, seed=5)[0], truth, scale=1.5))
    rigid = trajectory_errors(estimate, trajectory(truth))
    free = trajectory_errors(estimate, trajectory(truth), with_scale=True)
    spread = truth.translation - truth.translation.mean(axis=0)
    assert rigid.ate_rmse_m == pytest.approx(0.5 * np.sqrt((spread**2).sum(axis=1).mean()))
    assert free.ate_rmse_m == pytest.approx(0, abs=ATOL)
    assert free.scale == pytest.approx(1 / 1.5)


def test_statistics_of_known_errors():
    # Symmetric offsets along x cannot be aligned away.
    corners = np.array([[y, x, z] for y in (-1, 1) for x in (-1, 1) for z in (-1, 1)], float)
    truth = SE3(rotation=np.tile(np.eye(3), (8, 1, 1)), translation=corners * [2, 1, 1])
    signs = np.sign(corners[:, :1] * corners[:, 1:2])
    off = truth.translation + 0.01 * signs * [0, 0, 1]
    turned = rotation_from_vector(np.radians([[0, 0, 2.0]] * 8))
    estimate = SE3(rotation=truth.rotation @ turned, translation=off)
    errors = trajectory_errors(trajectory(estimate), trajectory(truth))
    for name in ("ate_rmse_m", "ate_mean_m", "ate_median_m", "ate_max_m"):
        assert getattr(errors, name) == pytest.approx(0.01, abs=ATOL)
    assert errors.rotation_rms_deg == pytest.approx(2.0, abs=1e-6)


def test_poses_outside_the_truth_do_not_count():
    truth = poses(50)
    shifted = trajectory(truth, start_us=455_000)
    assert trajectory_errors(shifted, trajectory(truth)).pose_count == 4
    with pytest.raises(TrajectoryError, match="at least 3 poses within the truth, found 2"):
        trajectory_errors(trajectory(truth, start_us=475_000), trajectory(truth))
