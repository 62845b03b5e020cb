import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from roel_service.errors import TrajectoryError
from roel_service.geometry.se3 import SE3, rotation_angle, rotation_from_vector
from roel_service.scene.trajectory import MAX_POSE_GAP_US, Trajectory


def trajectory(t_us):
    """Moves 1 m/s along x and turns 1 rad/s about z."""
    seconds = np.asarray(t_us) * 1e-6
    zero = np.zeros_like(seconds)
    return Trajectory(
        t_us=np.asarray(t_us),
        T_world_camera=SE3(
            rotation=rotation_from_vector(np.stack([zero, zero, seconds], axis=-1)),
            translation=np.stack([seconds, zero, zero], axis=-1),
        ),
    )


@given(st.lists(st.integers(0, 2_000_000), min_size=1, max_size=20))
def test_uniform_motion_is_interpolated_exactly(t_us):
    poses = trajectory([0, 300_000, 1_000_000, 2_000_000]).interpolate(np.array(t_us))
    seconds = np.array(t_us) * 1e-6
    np.testing.assert_allclose(poses.translation[:, 0], seconds, rtol=0, atol=1e-14)
    np.testing.assert_allclose(rotation_angle(poses.rotation), seconds, rtol=0, atol=1e-14)


def test_interpolation_passes_through_the_poses():
    given_poses = trajectory([0, 100, 250, 400])
    poses = given_poses.interpolate(given_poses.t_us)
    expected = given_poses.T_world_camera.matrix()
    np.testing.assert_allclose(poses.matrix(), expected, rtol=0, atol=1e-15)


def test_interpolation_takes_the_shorter_way_round():
    turn = rotation_from_vector(np.array([[0.0, 0, 3.0], [0.0, 0, -3.0]]))
    poses = Trajectory(
        t_us=np.array([0, 100]), T_world_camera=SE3(rotation=turn, translation=np.zeros((2, 3)))
    )
    # Half way from +3 to -3 rad over pi, not over zero.
    middle = poses.interpolate(np.array([50]))
    assert rotation_angle(middle.rotation)[0] == pytest.approx(np.pi, abs=1e-7)


@pytest.mark.parametrize("t_us", [-1, 401])
def test_times_outside_the_poses_are_refused(t_us):
    with pytest.raises(TrajectoryError, match="times within 0 and 400 us") as caught:
        trajectory([0, 200, 400]).interpolate(np.array([100, t_us]))
    assert caught.value.reason == "POSE_COVERAGE_INSUFFICIENT"


def test_interpolating_no_time_gives_no_pose():
    assert len(trajectory([0, 100]).interpolate(np.empty(0, np.int64))) == 0


def test_long_gaps_are_not_covered():
    gap_end_us = 100 + MAX_POSE_GAP_US
    poses = trajectory([0, 100, gap_end_us, 2 * gap_end_us])
    times_us = [-1, 0, 100, 101, gap_end_us, gap_end_us + 1, 2 * gap_end_us]
    # Poses themselves are covered, also at the border of a gap; the middle gap is just allowed.
    covered = [False, True, True, True, True, False, True]
    np.testing.assert_array_equal(poses.covers(np.array(times_us)), covered)


def test_covered_intervals_are_parted_by_long_gaps():
    gap_us = MAX_POSE_GAP_US + 1
    poses = trajectory([0, 100, 100 + gap_us, 200 + gap_us, 200 + 2 * gap_us])
    expected = [[0, 100], [100 + gap_us, 200 + gap_us], [200 + 2 * gap_us] * 2]
    np.testing.assert_array_equal(poses.covered_us(), expected)


@pytest.mark.parametrize(
    ("t_us", "expected"),
    [
        ([5], "at least 2 poses, found 1"),
        ([], "at least 2 poses, found 0"),
        ([0, 10, 10], "no increase at pose 2"),
        ([0, 10, 5, 20], "no increase at pose 2"),
    ],
)
def test_times_that_are_no_trajectory_are_refused(t_us, expected):
    with pytest.raises(TrajectoryError, match=expected):
        trajectory(t_us)


def test_every_time_needs_its_pose():
    with pytest.raises(TrajectoryError, match="one pose for each of 3 times"):
        Trajectory(
            t_us=np.array([0, 1, 2]),
            T_world_camera=SE3(
                rotation=np.tile(np.eye(3), (2, 1, 1)), translation=np.zeros((2, 3))
            ),
        )
