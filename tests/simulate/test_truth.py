import numpy as np
import pytest

from roel_service.geometry.se3 import SE3
from roel_service.simulate import textures
from roel_service.simulate.motion import looking_along
from roel_service.simulate.rooms import SceneBuilder, furnished_room, grid_cube
from roel_service.simulate.scenes import texture_atlas
from roel_service.simulate.truth import (
    CLOUD_NOISE_M,
    CLOUD_VOXEL_M,
    EDGE_VOXEL_M,
    EDGE_ZOOM,
    observable_edges,
    surface_cloud,
)

from .samples import DEPTH_M, FOCAL_PX, HEIGHT, WIDTH, K, unlit, wall_with_edge


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


def test_the_edges_of_the_cube_lie_on_its_rims_and_bars():
    cube = grid_cube()
    atlas = texture_atlas(cube.textures, grey=True)
    places = np.array([[20.0, 12.0, 10.0], [20.0, 12.0, 10.0]])
    poses = SE3(rotation=looking_along(-places), translation=places)
    zoom = 4
    sharp = K.copy()
    sharp[:2] *= zoom
    edges = observable_edges(cube, atlas, poses, sharp, zoom * WIDTH, zoom * HEIGHT, 2.0, step)
    inward = np.sort(5.0 - np.abs(edges), axis=1)
    # A pixel at the farthest corner, some 30 away, and half a voxel.
    pixel = 30.0 / (zoom * FOCAL_PX) / EDGE_ZOOM
    margin = pixel + EDGE_VOXEL_M
    assert np.abs(inward[:, 0]).max() < margin
    # On its face a point lies at the rim, the inner side of the rim's line, or beside the middle.
    line = 10.0 / 64
    from_rim, from_middle = inward[:, 1], np.sort(np.abs(edges), axis=1)[:, :2].min(axis=1)
    distance = np.min(np.abs([from_rim, from_rim - line, from_middle - line]), axis=0)
    # Canny errs by a pixel, the depth is that of a neighbour, and seen at 67 degrees from its normal,
    # as the upper face is, a pixel covers 2.5 times as much. Cells are 5 wide: points strewn over
    # the faces would lie farther off.
    assert np.quantile(distance, 0.95) < 5 * margin
    # Nothing of the three faces that cannot be seen, but their common rims.
    assert (edges > -5.0 - margin).all()
    assert len(edges) > 500


@pytest.mark.parametrize("angle_rad", np.linspace(0.1, 3.0, 12))
def test_a_silhouette_that_leaves_the_picture_has_the_depth_of_its_surface(angle_rad):
    # One half of the view, up to its border; the other is background.
    build = SceneBuilder()
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    half = np.array([[-9.0, 0.0], [9.0, 0.0], [9.0, -9.0], [-9.0, -9.0]])
    corners = half @ np.array([[cos, sin], [-sin, cos]])
    white = build.texture(textures.plain(np.ones(3)))
    build.quad(np.column_stack([corners, np.full(4, DEPTH_M)]), white)
    scene = unlit(build.scene())
    atlas = texture_atlas(scene.textures, grey=True)
    poses = SE3(rotation=np.tile(np.eye(3), (2, 1, 1)), translation=np.zeros((2, 3)))
    edges = observable_edges(scene, atlas, poses, K, WIDTH, HEIGHT, 1.0, step)
    assert len(edges) > HEIGHT
    np.testing.assert_allclose(edges[:, 2], DEPTH_M, atol=0.5 * EDGE_VOXEL_M + 1e-6)


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
