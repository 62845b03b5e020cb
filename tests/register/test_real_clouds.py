"""Scans of the real world, as point sets through the same core."""

import numpy as np
import pytest

from roel_bench.registration_scans import CLOUDS
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


def test_car_scans_are_registered_as_their_library_allows(data_folder):
    names = ("car_cloud401.csv", "car_cloud400.csv")
    (source, target), config = scans(data_folder, names, 0.05)
    result = register_map(source, target, config)
    table = (data_folder / "real" / "icp" / "carCloudList.csv").read_text().splitlines()[2]
    true = np.array(table.split(",")[1:], np.float64).reshape(4, 4)
    found = result.T_target_source
    # The bounds of libpointmatcher's own tests: 0.1 rad, and 0.1 m of difference in length.
    assert rotation_angle(found.rotation @ true[:3, :3].T) < 0.1
    lengths = [np.linalg.norm(t) for t in (found.translation, true[:3, 3])]
    assert abs(lengths[0] - lengths[1]) < 0.1
    assert result.verdict is Verdict.ACCEPTED


def test_clouds_of_vtk_are_registered_as_their_library_allows(data_folder):
    names = ("cloud.00001.vtk", "cloud.00000.vtk")
    (source, target), config = scans(data_folder, names, 0.05)
    result = register_map(source, target, config)
    ours = result.T_target_source @ source.points
    theirs = SE3.from_matrix(CLOUDS) @ source.points
    # The bound of libpointmatcher's own tests, against the outcome of its own ICP.
    assert np.median(np.abs(ours - theirs)) < 0.05 * np.median(np.abs(ours))
    assert result.verdict is Verdict.ACCEPTED
