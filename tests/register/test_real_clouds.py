"""Scans of the real world, as point sets through the same core."""

import numpy as np
import pytest

from roel_service.config.stages import RegisterConfig
from roel_service.geometry.se3 import SE3, rotation_angle, rotation_from_vector
from roel_service.io.clouds import read_cloud
from roel_service.io.transforms import read_transform
from roel_service.register.prepare import prepare_cloud
from roel_service.register.register import register_map
from roel_service.scene.results import Verdict

pytestmark = pytest.mark.data


def scans(data_folder, names, voxel_m):
    config = RegisterConfig(voxel_m=voxel_m, last_scale_m=voxel_m / 2, max_distance_m=2.5 * voxel_m)
    clouds = [read_cloud(data_folder / "real" / "icp" / name) for name in names]
    return [prepare_cloud(cloud, config) for cloud in clouds], config


def test_a_lidar_pair_is_registered_as_its_reference_says(data_folder):
    (source, target), config = scans(data_folder, ("source.ply", "target.ply"), 0.25)
    true = read_transform(data_folder / "real" / "icp" / "T_target_source.txt")
    found = register_map(source, target, config)
    off = found.T_target_source @ true.inverse()
    assert np.degrees(rotation_angle(off.rotation)) < 0.2
    assert np.linalg.norm(found.T_target_source.translation - true.translation) < 0.02
    assert found.verdict is Verdict.ACCEPTED


def test_a_turned_room_is_found_without_a_guess_and_from_one(data_folder):
    names = ("room_scan2.pcd", "room_scan1.pcd")
    (source, target), config = scans(data_folder, names, 0.06)
    guess = SE3(
        rotation=rotation_from_vector(np.array([0.0, 0.0, 0.6931])),
        translation=np.array([1.79387, 0.720047, 0.0]),
    )
    for options in ({"method": "global"}, {"T_init": guess}):
        T = register_map(source, target, config, **options).T_target_source
        yaw_deg = np.degrees(np.arctan2(T.rotation[1, 0], T.rotation[0, 0]))
        assert yaw_deg == pytest.approx(40.8, abs=0.3)
