import dataclasses

import numpy as np
import pytest

from roel_service.geometry.se3 import SE3
from roel_service.scene.camera import Camera, CameraModel
from roel_service.scene.events import EventStream
from roel_service.scene.trajectory import Trajectory
from roel_service.wire.provenance import EventDigest, camera_digest, poses_digest

CAMERA = Camera(width=20, height=10, fx_px=5, fy_px=6, cx_px=7, cy_px=8, distortion=(0, 0, 0, 1))


def stream(start, stop, **changes):
    columns = {
        "t_us": np.arange(100) * 3,
        "x": np.arange(100) % 20,
        "y": np.arange(100) % 10,
        "polarity": np.where(np.arange(100) % 2 == 0, 1, -1),
    } | changes
    return EventStream(
        **{name: values[start:stop] for name, values in columns.items()}, width=20, height=10
    )


def digest(*chunks):
    events = EventDigest()
    for chunk in chunks:
        events.update(chunk)
    return events.hexdigest()


def test_digest_of_events_does_not_depend_on_chunks():
    assert digest(stream(0, 33), stream(33, 33), stream(33, 100)) == digest(stream(0, 100))


@pytest.mark.parametrize("name", ["t_us", "x", "y", "polarity"])
def test_digest_of_events_depends_on_every_column(name):
    values = getattr(stream(0, 100), name).copy()
    values[99] = {"t_us": 1000, "x": 0, "y": 0, "polarity": 1}[name]
    assert digest(stream(0, 100, **{name: values})) != digest(stream(0, 100))


def test_digest_of_poses_depends_on_times_positions_and_rotations():
    quaternions = np.array([[0, 0, 0, 1.0], [0, 0, 0.6, 0.8]])
    poses = SE3.from_quaternion(quaternions, np.arange(6.0).reshape(2, 3))
    moved = SE3(rotation=poses.rotation, translation=poses.translation + 1e-9)
    turned = SE3(rotation=poses.rotation[::-1], translation=poses.translation)
    trajectories = [
        Trajectory(t_us=np.array([0, 1]), T_world_camera=poses),
        Trajectory(t_us=np.array([0, 2]), T_world_camera=poses),
        Trajectory(t_us=np.array([0, 1]), T_world_camera=moved),
        Trajectory(t_us=np.array([0, 1]), T_world_camera=turned),
    ]
    assert len({poses_digest(trajectory) for trajectory in trajectories}) == 4


@pytest.mark.parametrize(
    "changes",
    [
        {"width": 21},
        {"height": 11},
        {"fx_px": 5.5},
        {"cy_px": 8.5},
        {"model": CameraModel.FISHEYE},
        {"distortion": ()},
    ],
)
def test_digest_of_a_camera_depends_on_every_value(changes):
    assert camera_digest(dataclasses.replace(CAMERA, **changes)) != camera_digest(CAMERA)
