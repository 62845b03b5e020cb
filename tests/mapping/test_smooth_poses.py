import numpy as np
import pytest

from roel_service.evaluation.poses import rotation_errors_rad, translation_errors_m
from roel_service.geometry.se3 import SE3
from roel_service.mapping.smooth_poses import smoothed
from roel_service.scene.trajectory import Trajectory

from .synthetic import path, trajectory

JITTER_M, JITTER_RAD = 0.003, 0.002


def jittered(truth, seed=0):
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(len(truth), 6)) * ([JITTER_RAD] * 3 + [JITTER_M] * 3)
    return Trajectory(t_us=truth.t_us, T_world_camera=truth.T_world_camera.retract(noise))


@pytest.mark.parametrize("seed", range(3))
def test_jitter_is_taken_out(seed):
    truth = trajectory()
    found = smoothed(jittered(truth, seed)).T_world_camera
    noise_m = JITTER_M * np.sqrt(3)
    # Some 400 poses and a dozen free numbers a coordinate: a fifth of the noise is left; a third
    # leaves room for the draw.
    assert translation_errors_m(found, truth.T_world_camera).mean() < noise_m / 3
    assert rotation_errors_rad(found, truth.T_world_camera).mean() < JITTER_RAD * np.sqrt(3) / 3


def test_poses_without_noise_stay():
    truth = trajectory()
    found = smoothed(truth).T_world_camera
    np.testing.assert_allclose(found.translation, truth.T_world_camera.translation, atol=1e-6)
    np.testing.assert_allclose(found.rotation, truth.T_world_camera.rotation, atol=1e-6)


def test_nothing_is_smoothed_across_a_gap():
    t_us = np.concatenate([np.arange(0, 500_000, 5_000), np.arange(1_500_000, 2_000_000, 5_000)])
    noisy = jittered(Trajectory(t_us=t_us, T_world_camera=path(t_us)))
    first = Trajectory(t_us=t_us[:100], T_world_camera=noisy.T_world_camera[:100])
    together, alone = smoothed(noisy).T_world_camera, smoothed(first).T_world_camera
    np.testing.assert_array_equal(together.translation[:100], alone.translation)


def test_the_side_of_a_quaternion_does_not_matter():
    # A full turn about z passes both signs of a quaternion.
    angle = np.linspace(0.0, 2 * np.pi, 400)
    quaternion = np.zeros((400, 4))
    quaternion[:, 2], quaternion[:, 3] = np.sin(angle / 2), np.cos(angle / 2)
    turning = SE3.from_quaternion(quaternion, np.zeros((400, 3)))
    noisy = jittered(Trajectory(t_us=np.arange(400) * 5_000, T_world_camera=turning))
    errors_rad = rotation_errors_rad(smoothed(noisy).T_world_camera, turning)
    assert errors_rad.max() < 2 * JITTER_RAD


def test_a_handful_of_poses_stays():
    t_us = np.arange(5) * 10_000
    few = Trajectory(t_us=t_us, T_world_camera=path(t_us))
    np.testing.assert_array_equal(
        smoothed(few).T_world_camera.translation, few.T_world_camera.translation
    )
