import dataclasses

import numpy as np
import pytest

from roel_service.mapping.joint import refine_jointly
from roel_service.mapping.pose_correction import PoseCorrection
from roel_service.mapping.time_offset import TimeOffset, time_offset, velocities
from roel_service.scene.trajectory import Trajectory

from .synthetic import DURATION_US, trajectory, world
from .test_joint import CONFIG, DRIFT, INTERVAL_US, error, lines_of, seen

# Poses reach beyond the recording, so that late ones cover it too.
REACH_US = 100_000


def stamped(late_us):
    """True poses whose times are off."""
    given = trajectory(first_us=-REACH_US, last_us=DURATION_US + REACH_US)
    return Trajectory(t_us=given.t_us + late_us, T_world_camera=given.T_world_camera)


@pytest.mark.parametrize("late_us", [0, -20_000, 30_000])
@pytest.mark.parametrize("drift", [0.0, 0.3])
def test_the_offset_is_found(late_us, drift):
    exact = world()
    given = stamped(late_us)
    wrong = error(size_rad=0.004 * drift, size_m=0.006 * drift)
    poses = wrong.applied(exact.frames.t_us, given.interpolate(exact.frames.t_us))
    detected = seen(exact)
    frames = dataclasses.replace(detected.frames, T_world_camera=poses)
    detected = dataclasses.replace(detected, frames=frames)
    none = PoseCorrection.none(trajectory(), INTERVAL_US)
    start = lines_of(exact, detected)
    joint = refine_jointly(start, none, DRIFT, detected, CONFIG, None, free_lines=False)
    found = time_offset(joint, given)
    assert found.offset_us == pytest.approx(-late_us, abs=max(1_500, 3.0 * found.sigma_us))
    assert found.exceeds(4_000, 4.0) == (late_us != 0)


def test_a_camera_that_stands_still_tells_nothing():
    exact = world()
    given = trajectory()
    still = Trajectory(t_us=given.t_us, T_world_camera=given.T_world_camera[[0] * len(given)])
    detected = seen(exact, error())
    none = PoseCorrection.none(given, INTERVAL_US)
    start = lines_of(exact, detected)
    joint = refine_jointly(start, none, DRIFT, detected, CONFIG, None, free_lines=False)
    assert time_offset(joint, still) == TimeOffset(offset_us=0.0, sigma_us=float("inf"))


def test_velocities_are_those_of_the_trajectory():
    given = trajectory()
    t_us = np.array([200_000, 500_000])
    span_us = 40_000
    before, after = given.interpolate(t_us - span_us // 2), given.interpolate(t_us + span_us // 2)
    found = velocities(given, t_us)
    steps = (after.translation - before.translation) / (span_us * 1e-6)
    np.testing.assert_allclose(found[:, 3:], steps, atol=1e-9)
    turned = before.retract(found * span_us * 1e-6)
    np.testing.assert_allclose(turned.rotation, after.rotation, atol=1e-9)
    # Beyond the ends the nearest velocity is that of the end.
    np.testing.assert_array_equal(velocities(given, np.array([-10]))[0], velocities(given, [0])[0])
