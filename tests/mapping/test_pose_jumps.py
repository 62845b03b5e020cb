import numpy as np
import pytest

from roel_service.mapping.pose_jumps import pose_jumps
from roel_service.scene.trajectory import Trajectory

from .synthetic import trajectory


def moved(step, at, sigma=0.0):
    """The trajectory, off by a tangent from one pose on, with jitter."""
    given = trajectory()
    tangents = np.random.default_rng(0).normal(size=(len(given), 6)) * sigma
    tangents[at:] += step
    poses = given.T_world_camera.retract(tangents)
    return Trajectory(t_us=given.t_us, T_world_camera=poses)


@pytest.mark.parametrize("sigma", [0.0, 0.0005])
def test_motion_and_jitter_are_no_jumps(sigma):
    assert not pose_jumps(moved(np.zeros(6), 0, sigma)).any()


@pytest.mark.parametrize("sigma", [0.0, 0.0005])
@pytest.mark.parametrize("axis", [1, 4])
def test_a_jump_is_found_where_it_is(axis, sigma):
    step = 0.3 * np.eye(6)[axis]
    assert np.flatnonzero(pose_jumps(moved(step, 40, sigma))).tolist() == [39]


def test_a_few_poses_have_none():
    given = trajectory()
    few = Trajectory(t_us=given.t_us[:3], T_world_camera=given.T_world_camera[:3])
    assert not pose_jumps(few).any()
