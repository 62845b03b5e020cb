import numpy as np
import pytest

from roel_service.evaluation import pose_figures
from roel_service.evaluation.pose_figures import draw_trajectories
from roel_service.scene.trajectory import Trajectory

from ..mapping.synthetic import trajectory


def shifted(given, tangent):
    poses = given.T_world_camera.retract(np.broadcast_to(tangent, (len(given), 6)))
    return Trajectory(t_us=given.t_us, T_world_camera=poses)


@pytest.mark.parametrize("with_truth", [False, True])
def test_a_picture_is_written(with_truth, tmp_path):
    truth = trajectory()
    given = shifted(truth, [0, 0, 0, 0.1, 0, 0])
    path = tmp_path / "poses.png"
    draw_trajectories(given, truth, truth if with_truth else None, path)
    assert path.read_bytes().startswith(b"\x89PNG")


def test_differences_are_those_of_the_poses():
    truth = trajectory()
    off = shifted(truth, [0.02, 0, 0, 0.003, 0, 0.004])
    distances_mm, angles_deg = pose_figures._differences(off, truth)
    np.testing.assert_allclose(distances_mm, 5.0)
    np.testing.assert_allclose(angles_deg, np.degrees(0.02))


def test_poses_are_drawn_in_the_world_of_the_truth():
    truth = trajectory()
    part = Trajectory(t_us=truth.t_us[10:], T_world_camera=truth.T_world_camera[10:])
    found = pose_figures._aligned(shifted(truth, [0, 0, 0, 1.0, 2.0, 3.0]), part)
    np.testing.assert_array_equal(found.t_us, part.t_us)
    np.testing.assert_allclose(
        found.T_world_camera.translation, part.T_world_camera.translation, atol=1e-9
    )
