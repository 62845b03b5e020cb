import contextlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from roel_service.errors import InputError, TrajectoryError
from roel_service.geometry.se3 import SE3
from roel_service.io.poses import read_trajectory, write_trajectory
from roel_service.io.text import MAX_TIME_US
from roel_service.scene.trajectory import Trajectory

IDENTITY = "0 0 0 0 0 0 1"


def read_lines(tmp_path, *lines):
    path = tmp_path / "poses.txt"
    path.write_text("".join(f"{line}\n" for line in lines))
    return read_trajectory(path)


def refused(tmp_path, *lines):
    with pytest.raises(TrajectoryError) as caught:
        read_lines(tmp_path, *lines)
    assert caught.value.subject == str(tmp_path / "poses.txt")
    assert caught.value.reason == "POSES_INVALID"
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_columns_are_seconds_position_and_quaternion(tmp_path):
    half = np.sqrt(0.5)
    poses = read_lines(
        tmp_path, "# t tx ty tz qx qy qz qw", f"1.5 1 2 3 0 0 {half} {half}", f"2 {IDENTITY}"
    )
    assert poses.t_us.tolist() == [1_500_000, 2_000_000]
    # A quarter turn about z takes the camera's x axis to the world's y axis.
    moved = poses.T_world_camera[0] @ np.array([1.0, 0.0, 0.0])
    np.testing.assert_allclose(moved, [1, 3, 3], atol=1e-15)  # m, float64


def test_quaternion_within_tolerance_is_normalised(tmp_path):
    poses = read_lines(tmp_path, "0 0 0 0 0 0 0 1.009", f"1 {IDENTITY}")
    np.testing.assert_allclose(poses.T_world_camera.rotation[0], np.eye(3), atol=1e-15)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([], "at least 2 poses, found 0"),
        ([f"0 {IDENTITY}"], "at least 2 poses, found 1"),
        ([f"0 {IDENTITY}", "", "1 0 0 0 0 0 0"], "line 3"),
        ([f"0 {IDENTITY}", f"1 {IDENTITY} 9"], "line 2"),
        ([f"0 {IDENTITY}", "1 nan 0 0 0 0 0 1"], "line 2"),
        ([f"0 {IDENTITY}", "1 0 inf 0 0 0 0 1"], "line 2"),
        (["# comment", f"0 {IDENTITY}", "1 0 0 0 0 0 0 1.011"], "norm 1, found 1.011 in line 3"),
        ([f"0 {IDENTITY}", "1 0 0 0 0 0 0 0"], "norm 1, found 0.0 in line 2"),
        ([f"0 {IDENTITY}", "1 0 0 0 1e200 0 0 1e200"], "line 2"),
        ([f"2 {IDENTITY}", f"1 {IDENTITY}"], "increase by a microsecond or more, found 1.0 in"),
        ([f"1 {IDENTITY}", f"2 {IDENTITY}", f"2.0000001 {IDENTITY}"], "line 3"),
        ([f"0 {IDENTITY}", f"1e308 {IDENTITY}"], "line 2"),
    ],
)
def test_what_is_no_trajectory_is_named_with_its_line(tmp_path, lines, message):
    assert message in refused(tmp_path, *lines)


trajectories = st.lists(
    st.tuples(
        st.integers(-MAX_TIME_US + 1, MAX_TIME_US - 1),
        st.tuples(*[st.floats(-1e6, 1e6)] * 3),
        st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1),
    ),
    min_size=2,
    max_size=8,
    unique_by=lambda pose: pose[0],
)


@given(trajectories)
@settings(deadline=None)
def test_written_poses_are_read_back(tmp_path_factory, poses):
    t_us, positions, quaternions = zip(*sorted(poses), strict=True)
    trajectory = Trajectory(
        t_us=np.array(t_us),
        T_world_camera=SE3.from_quaternion(np.array(quaternions), np.array(positions)),
    )
    path = tmp_path_factory.mktemp("poses") / "p.txt"
    write_trajectory(path, trajectory)
    back = read_trajectory(path)
    np.testing.assert_array_equal(back.t_us, trajectory.t_us)
    np.testing.assert_array_equal(
        back.T_world_camera.translation, trajectory.T_world_camera.translation
    )
    # Matrix to quaternion and back: a few float64 roundings.
    np.testing.assert_allclose(
        back.T_world_camera.rotation, trajectory.T_world_camera.rotation, rtol=0, atol=1e-14
    )


@given(st.binary(max_size=120))
@settings(deadline=None)
def test_any_bytes_are_refused_or_poses(tmp_path_factory, content):
    path = tmp_path_factory.mktemp("poses") / "p.txt"
    path.write_bytes(content)
    with contextlib.suppress(InputError):
        assert len(read_trajectory(path)) >= 2
