import numpy as np
import pytest

from roel_service.geometry.alignment import align_points
from roel_service.geometry.se3 import rotation_angle
from roel_service.simulate.motion import (
    JITTER_M,
    POSE_INTERVAL_US,
    TREMOR_M,
    TREMOR_RAD,
    TURN_S,
    as_odometry,
    looking_along,
    walk_around,
    walk_in_room,
    with_white_noise,
)

BOUNDS_M = np.array([[0.0, 0.0, 0.0], [4.6, 5.0, 2.7]])
SEEDS = range(5)
FINE_US = np.arange(0, 7_000_000, 1_000)


@pytest.fixture(params=SEEDS)
def walk(request):
    return walk_in_room(BOUNDS_M, np.random.default_rng(request.param))


def test_a_walk_stays_clear_of_walls_floor_and_ceiling(walk):
    place_m = walk.poses(FINE_US).translation
    clearance_m = np.minimum(place_m - BOUNDS_M[0], BOUNDS_M[1] - place_m).min()
    assert clearance_m > 0.8


def test_a_turn_ends_where_it_began(walk):
    turn_us = round(TURN_S * 1e6)
    ends = walk.poses(np.array([0, turn_us]))
    # Only the tremor differs: two values of standard deviation TREMOR, at most a few of them apart.
    distance_m = np.linalg.norm(ends.translation[1] - ends.translation[0])
    assert distance_m < 6 * np.sqrt(3) * TREMOR_M
    assert rotation_angle(ends.rotation[0].T @ ends.rotation[1]) < 6 * np.sqrt(3) * TREMOR_RAD


def test_a_walk_turns_once_all_around(walk):
    forward = walk.poses(FINE_US).rotation[:, :2, 2]
    heading_rad = np.unwrap(np.arctan2(forward[:, 1], forward[:, 0]))
    assert abs(heading_rad[-1] - heading_rad[0]) == pytest.approx(2 * np.pi, abs=0.3)


def test_a_walk_has_the_speed_of_a_hand_and_no_jolts(walk):
    place_m = walk.poses(FINE_US).translation
    speed_m_s = np.diff(place_m, axis=0) * 1e3
    assert 0.3 < np.linalg.norm(speed_m_s, axis=1).mean() < 2.0
    # Sines of at most 3 Hz and 2 cm, and 1.2 m around in 7 s: below 3 g in all.
    acceleration_m_s2 = np.diff(speed_m_s, axis=0) * 1e3
    assert np.linalg.norm(acceleration_m_s2, axis=1).max() < 30.0


def test_poses_are_dense_enough_to_be_interpolated(walk):
    duration_us = 1_000_000
    trajectory = walk.trajectory(duration_us)
    between_us = np.arange(POSE_INTERVAL_US // 2, duration_us, POSE_INTERVAL_US)
    true, guessed = walk.poses(between_us), trajectory.interpolate(between_us)
    # a T^2 / 8 with T = 5 ms and a below 30 m/s^2 is 0.1 mm.
    assert np.linalg.norm(true.translation - guessed.translation, axis=1).max() < 1e-4
    turn = np.swapaxes(true.rotation, -1, -2) @ guessed.rotation
    # Likewise; 2e-4 rad are 0.05 px at 240 px focal length.
    assert rotation_angle(turn).max() < 2e-4


@pytest.mark.parametrize("duration_us", [1, 4_999, 5_000, 123_456])
def test_a_trajectory_covers_the_whole_duration(walk, duration_us):
    t_us = walk.trajectory(duration_us).t_us
    assert t_us[0] == 0
    assert t_us[-1] >= duration_us
    assert (np.diff(t_us) == POSE_INTERVAL_US).all()


def test_the_camera_is_held_upright():
    look = np.random.default_rng(0).normal(size=(50, 3))
    R = looking_along(look)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-12)
    np.testing.assert_allclose(R[:, 2, 0], 0.0, atol=1e-12)  # right is level
    assert (R[:, 2, 1] < 0).all()  # down points down
    np.testing.assert_allclose(
        R[:, :, 2], look / np.linalg.norm(look, axis=1, keepdims=True), atol=1e-12
    )


def test_the_walk_around_the_cube_looks_at_it_from_its_distance():
    poses = walk_around(25.0, np.random.default_rng(1)).poses(FINE_US)
    distance = np.linalg.norm(poses.translation, axis=1)
    # Tremor of 2 % of the distance.
    np.testing.assert_allclose(distance, 25.0, atol=0.1 * 25.0)
    towards = -poses.translation / distance[:, None]
    off_rad = np.arccos(np.clip(np.sum(towards * poses.rotation[:, :, 2], axis=1), -1, 1))
    assert off_rad.max() < 6 * np.sqrt(3) * TREMOR_RAD


def test_odometry_errs_by_millimetres_and_tenths_of_a_degree():
    errors_m, errors_deg = [], []
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        true = walk_in_room(BOUNDS_M, rng).trajectory(6_000_000)
        guessed = as_odometry(true, 1.0, rng)
        np.testing.assert_array_equal(guessed.t_us, true.t_us)
        tangent = true.T_world_camera.local(guessed.T_world_camera)
        errors_m.append(np.sqrt(np.mean(np.sum(tangent[:, 3:] ** 2, axis=1))))
        errors_deg.append(np.rad2deg(np.sqrt(np.mean(np.sum(tangent[:, :3] ** 2, axis=1)))))
    # Per axis 2.2 mm of jitter and 4.5 mm of drift: 8.7 mm in three axes; 0.45 degrees likewise.
    # A drift that forgets in 1.5 s has about 4 independent values in 6 s, in 3 axes, 5 times over.
    assert np.mean(errors_m) == pytest.approx(8.7e-3, rel=0.4)
    assert np.mean(errors_deg) == pytest.approx(0.45, rel=0.4)


def test_odometry_errs_by_millimetres_after_alignment():
    ates_m = []
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        true = walk_in_room(BOUNDS_M, rng).trajectory(6_000_000)
        place_m = true.T_world_camera.translation
        guessed_m = as_odometry(true, 1.0, rng).T_world_camera.translation
        aligned_m = align_points(guessed_m, place_m, with_scale=False).apply(guessed_m)
        ates_m.append(np.sqrt(np.mean(np.sum((aligned_m - place_m) ** 2, axis=1))))
    # 8.7 mm as above, less what the alignment takes of a slow drift; never below the jitter alone.
    assert np.sqrt(3) * JITTER_M < min(ates_m)
    assert max(ates_m) < 8.7e-3 * 1.4


def test_poses_of_the_cube_err_by_a_third_of_a_unit():
    true = walk_around(25.0, np.random.default_rng(0)).trajectory(6_000_000).T_world_camera
    noisy = with_white_noise(true, 1.0, np.random.default_rng(1))
    tangent = true.local(noisy)
    np.testing.assert_allclose(tangent[0], 0.0, atol=1e-12)
    error = np.sqrt(np.mean(np.sum(tangent[:, 3:] ** 2, axis=1)))
    assert error == pytest.approx(0.3325, rel=0.05)
    # Every pose is off by itself.
    assert np.abs(np.mean(tangent[1:, 3] * tangent[:-1, 3])) < 0.1 * np.mean(tangent[:, 3] ** 2)
