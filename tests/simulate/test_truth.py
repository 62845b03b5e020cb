import numpy as np
import pytest

from roel_service.geometry.se3 import SE3
from roel_service.simulate.rooms import furnished_room
from roel_service.simulate.scenes import texture_atlas
from roel_service.simulate.truth import (
    CLOUD_NOISE_M,
    CLOUD_VOXEL_M,
    EDGE_VOXEL_M,
    EDGE_ZOOM,
    observable_edges,
    surface_cloud,
)

from .samples import DEPTH_M, FOCAL_PX, HEIGHT, WIDTH, K, wall_with_edge


def step(done: int, total: int) -> None:
    assert 0 <= done <= total


def edges_of_wall(normal: np.ndarray, places: list[tuple[float, float, float]]) -> np.ndarray:
    scene = wall_with_edge(normal)
    atlas = texture_atlas(scene.textures, grey=True)
    poses = SE3(rotation=np.tile(np.eye(3), (len(places), 1, 1)), translation=np.array(places))
    return observable_edges(scene, atlas, poses, K, WIDTH, HEIGHT, 1.0, step)


@pytest.mark.parametrize("angle_rad", [0.0, 0.5, np.pi / 2])
def test_edge_points_lie_on_the_edge(angle_rad):
    normal = np.array([np.cos(angle_rad), np.sin(angle_rad)])
    edges = edges_of_wall(normal, [(0.0, 0.0, 0.0), (0.0, 0.0, 0.0)])
    pixel_m = DEPTH_M / FOCAL_PX / EDGE_ZOOM
    # Canny is good to a pixel, the voxel's middle to half its diagonal.
    assert np.abs(edges[:, :2] @ normal).max() < pixel_m + EDGE_VOXEL_M
    np.testing.assert_allclose(edges[:, 2], DEPTH_M, atol=0.5 * EDGE_VOXEL_M + 1e-6)
    along = edges[:, :2] @ np.array([-normal[1], normal[0]])
    # The edge crosses the whole picture, whose shorter side is HEIGHT.
    assert np.ptp(along) > 0.9 * HEIGHT * DEPTH_M / FOCAL_PX
    assert len(edges) > HEIGHT


def test_what_is_seen_once_does_not_count():
    far_apart = [(0.0, 0.0, 0.0), (0.0, 50.0, 0.0)]
    assert len(edges_of_wall(np.array([1.0, 0.0]), far_apart)) == 0


def test_a_cloud_lies_on_the_surfaces_but_for_its_noise():
    scene = wall_with_edge(np.array([1.0, 0.0]))
    cloud = surface_cloud(scene, np.array([[0.0, 0.0, 0.0]]), 1.0, np.random.default_rng(0))
    deviation_m = cloud[:, 2] - DEPTH_M
    assert deviation_m.std() == pytest.approx(CLOUD_NOISE_M, rel=0.1)
    assert abs(deviation_m.mean()) < 5 * CLOUD_NOISE_M / np.sqrt(len(cloud))


def test_a_cloud_holds_one_point_a_voxel_of_all_of_the_room():
    room = furnished_room(np.random.default_rng(1))
    size_m = np.ptp(room.bounds_m, axis=0)
    places = room.bounds_m[1] / 2 + np.array([[0.3, 0.2, 0.0], [-0.4, 0.1, 0.2]])
    cloud = surface_cloud(room, places, 1.0, np.random.default_rng(0))
    shell_m2 = 2 * (size_m[0] * size_m[1] + size_m[2] * (size_m[0] + size_m[1]))
    # At most one point in 4 cm^2 of an upright surface, up to twice that where one is cut aslant,
    # and furniture shows about as much again.
    per_voxel = len(cloud) * CLOUD_VOXEL_M**2 / shell_m2
    assert 0.3 < per_voxel < 2.5
    noise_m = 6 * CLOUD_NOISE_M
    assert (cloud > room.bounds_m[0] - noise_m).all()
    assert (cloud < room.bounds_m[1] + noise_m).all()
    # All six sides are there.
    reached = np.concatenate(
        [cloud.min(axis=0) - room.bounds_m[0], room.bounds_m[1] - cloud.max(axis=0)]
    )
    assert np.abs(reached).max() < noise_m
