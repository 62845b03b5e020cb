import numpy as np
import pytest

from roel_service.evaluation.maps import distances_to_mesh
from roel_service.geometry.se3 import SE3
from roel_service.scene.clouds import TriangleMesh
from roel_service.simulate.curved import SIDE_COUNT, circle, curved_room
from roel_service.simulate.motion import walk_in_room
from roel_service.simulate.panoramas import FACE_ROTATIONS
from roel_service.simulate.render import render_depth
from roel_service.simulate.truth import edges_along

# A view of 90 degrees.
SIZE = 48
K = np.array([[SIZE / 2, 0, (SIZE - 1) / 2], [0, SIZE / 2, (SIZE - 1) / 2], [0, 0, 1.0]])


@pytest.fixture(scope="module", params=range(3))
def room(request):
    return curved_room(np.random.default_rng(request.param))


def test_a_circle_closes_and_half_of_one_does_not():
    closed = circle(np.array([1.0, 2.0, 3.0]), 0.5)
    assert closed.shape == (SIDE_COUNT + 1, 3)
    np.testing.assert_allclose(closed[0], closed[-1], atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(closed - [1.0, 2.0, 3.0], axis=1), 0.5)
    half = circle(np.zeros(3), 1.0, turn_rad=np.pi)
    np.testing.assert_allclose(half[-1], [-1.0, 0.0, 0.0], atol=1e-15)


def test_equal_seeds_give_equal_rooms():
    first, again, other = (curved_room(np.random.default_rng(seed)) for seed in (1, 1, 7))
    np.testing.assert_array_equal(again.triangles, first.triangles)
    assert not np.array_equal(other.triangles, first.triangles)


def test_every_rim_is_an_edge_of_a_surface(room):
    mesh = TriangleMesh(triangles=room.triangles.astype(np.float32))
    # Corners in float32, some metres from the origin.
    assert distances_to_mesh(np.concatenate(room.rims), mesh).max() < 1e-5


def test_triangles_have_an_area(room):
    sides = room.triangles[:, 1:] - room.triangles[:, :1]
    assert np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).min() > 1e-6


def test_the_walk_is_free_and_the_room_is_closed(room):
    motion = walk_in_room(room.bounds_m, np.random.default_rng(0))
    for place in motion.poses(np.arange(0, 7_000_000, 1_000_000)).translation:
        for rotation in FACE_ROTATIONS:
            pose = SE3(rotation=rotation, translation=place)
            depth_m = render_depth(room, pose, K, SIZE, SIZE)
            assert np.isfinite(depth_m).all()
            assert depth_m.min() > 0.2


def test_edges_along_rims_are_those_beside_them():
    rim = circle(np.zeros(3), 1.0)
    edges = np.array([[1.0, 0, 0.004], [0, 1.0, 0.02], [0, 0, 0], [-1.0, 0, 0]], np.float32)
    np.testing.assert_array_equal(edges_along((rim,), edges, 1.0), edges[[0, 3]])
    np.testing.assert_array_equal(edges_along((rim,), edges, 3.0), edges[[0, 1, 3]])
