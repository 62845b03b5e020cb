import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from roel_service.errors import CameraError, TrajectoryError
from roel_service.geometry.se3 import SE3, rotation_from_vector
from roel_service.scene.camera import DISTORTION_COUNTS, Camera, CameraModel
from roel_service.scene.trajectory import Trajectory
from roel_service.v1 import types_pb2
from roel_service.wire.nouns import (
    bounds_from_proto,
    bounds_to_proto,
    camera_from_proto,
    camera_to_proto,
    trajectory_from_proto,
    trajectory_to_proto,
)

FINITE = st.floats(-1e6, 1e6)


@st.composite
def cameras(draw):
    model = draw(st.sampled_from(CameraModel))
    count = draw(st.sampled_from(DISTORTION_COUNTS[model]))
    return Camera(
        width=draw(st.integers(1, 65535)),
        height=draw(st.integers(1, 65535)),
        fx_px=draw(st.floats(1e-3, 1e5)),
        fy_px=draw(st.floats(1e-3, 1e5)),
        cx_px=draw(FINITE),
        cy_px=draw(FINITE),
        model=model,
        distortion=tuple(draw(st.lists(FINITE, min_size=count, max_size=count))),
    )


def trajectory_of(count, seed=0):
    rng = np.random.default_rng(seed)
    rotation = rotation_from_vector(rng.normal(size=(count, 3)))
    poses = SE3(rotation=rotation, translation=rng.normal(size=(count, 3)))
    return Trajectory(t_us=np.arange(count) * 5000, T_world_camera=poses)


@given(cameras())
def test_cameras_round_trip(camera):
    assert camera_from_proto(camera_to_proto(camera)) == camera


def test_a_camera_without_a_model_is_refused():
    message = types_pb2.Camera(width=4, height=4, fx_px=1, fy_px=1)
    with pytest.raises(CameraError, match="model PINHOLE or FISHEYE"):
        camera_from_proto(message)


@given(st.integers(2, 40), st.integers(0, 2**31))
def test_trajectories_round_trip_bit_for_bit(count, seed):
    trajectory = trajectory_of(count, seed)
    restored = trajectory_from_proto(trajectory_to_proto(trajectory))
    np.testing.assert_array_equal(restored.t_us, trajectory.t_us)
    poses, expected = restored.T_world_camera, trajectory.T_world_camera
    np.testing.assert_array_equal(poses.rotation, expected.rotation)
    np.testing.assert_array_equal(poses.translation, expected.translation)


def test_parts_join_in_their_order():
    whole = trajectory_to_proto(trajectory_of(5))
    first = types_pb2.Trajectory(
        t_us=whole.t_us[:8], translation_m=whole.translation_m[:24], rotation=whole.rotation[:72]
    )
    rest = types_pb2.Trajectory(
        t_us=whole.t_us[8:], translation_m=whole.translation_m[24:], rotation=whole.rotation[72:]
    )
    assert len(trajectory_from_proto(first, rest)) == 5
    with pytest.raises(TrajectoryError, match="strictly increasing"):
        trajectory_from_proto(rest, first)


@pytest.mark.parametrize(
    ("column", "values", "message"),
    [
        ("t_us", b"\0" * 9, "t_us in rows of 8 bytes, found 9 bytes"),
        ("t_us", b"\0" * 8, "as many times as positions"),
        ("translation_m", np.array([[0, 0, 0], [0, np.nan, 0], [0, 0, 0.0]]).tobytes(), "pose 1"),
        ("rotation", np.zeros((3, 3, 3)).tobytes(), "rotation matrices, found none at pose 0"),
        ("rotation", np.stack([np.eye(3)] * 2 + [-np.eye(3)]).tobytes(), "none at pose 2"),
        ("rotation", np.full((3, 3, 3), np.nan).tobytes(), "none at pose 0"),
        ("rotation", np.full((3, 3, 3), 1e300).tobytes(), "none at pose 0"),
        ("t_us", np.zeros(3, "<i8").tobytes(), "strictly increasing"),
    ],
)
def test_columns_that_are_no_poses_are_refused(column, values, message):
    part = trajectory_to_proto(trajectory_of(3))
    setattr(part, column, values)
    with pytest.raises(TrajectoryError, match=message):
        trajectory_from_proto(part)


def test_no_parts_are_no_poses():
    with pytest.raises(TrajectoryError, match="at least 2 poses"):
        trajectory_from_proto(types_pb2.Trajectory())


def test_bounds_round_trip():
    lower, upper = bounds_from_proto(bounds_to_proto(np.array([1.0, 2, 3]), np.array([4.0, 5, 6])))
    np.testing.assert_array_equal(lower, [1, 2, 3])
    np.testing.assert_array_equal(upper, [4, 5, 6])
