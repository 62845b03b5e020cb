import numpy as np
import pytest

from roel_service.geometry.se3 import SE3
from roel_service.simulate.motion import walk_in_room
from roel_service.simulate.panoramas import FACE_ROTATIONS
from roel_service.simulate.render import render, render_depth
from roel_service.simulate.rooms import Wall, furnished_room, grid_cube
from roel_service.simulate.scenes import texture_atlas

SEEDS = range(6)
# A view of 90 degrees.
SIZE = 48
K = np.array([[SIZE / 2, 0, (SIZE - 1) / 2], [0, SIZE / 2, (SIZE - 1) / 2], [0, 0, 1.0]])


@pytest.fixture(params=SEEDS)
def room(request):
    return furnished_room(np.random.default_rng(request.param))


def test_a_room_is_closed_all_around(room):
    centre = room.bounds_m.mean(axis=0)
    for rotation in FACE_ROTATIONS:
        pose = SE3(rotation=rotation, translation=centre)
        assert np.isfinite(render_depth(room, pose, K, SIZE, SIZE)).all()


def test_a_room_is_furnished_and_inside_its_walls(room):
    assert len(room.triangles) > 500
    size_m = room.bounds_m[1] - room.bounds_m[0]
    assert (size_m > [4.0, 4.0, 2.4]).all()
    assert (size_m < [6.0, 6.0, 3.0]).all()


def test_triangles_of_a_room_have_an_area(room):
    sides = room.triangles[:, 1:] - room.triangles[:, :1]
    area_m2 = 0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    assert area_m2.min() > 1e-6


def test_textures_hold_reflectances(room):
    for texture in room.textures:
        assert texture.dtype == np.float32
        assert texture.min() >= 0.0
        assert texture.max() <= 1.0
    assert room.texture.max() < len(room.textures)


def test_nothing_stands_in_the_way_of_the_walk(room):
    motion = walk_in_room(room.bounds_m, np.random.default_rng(0))
    for place in motion.poses(np.arange(0, 7_000_000, 500_000)).translation:
        nearest_m = min(
            render_depth(room, SE3(rotation=rotation, translation=place), K, SIZE, SIZE).min()
            for rotation in FACE_ROTATIONS
        )
        # Depth along the axis of a view of 90 degrees: the distance is at most 1.7 times that.
        assert nearest_m > 0.2


def test_what_hangs_on_a_wall_does_not_overlap():
    wall = Wall(0, np.array([5.0, 4.0, 2.5]))
    assert wall.is_free(0.0, 5.0)
    wall.take(1.0, 0.8)
    wall.take(-1.5, 0.4)
    taken = [wall.is_free(along_m, 0.4) for along_m in (-1.5, -1.2, -1.0, 0.35, 0.5, 1.0, 1.65)]
    assert taken == [False, False, True, True, False, False, True]


@pytest.mark.parametrize("side", range(4))
def test_a_wall_is_a_frame_that_looks_into_the_room(side):
    size = np.array([5.0, 4.0, 2.5])
    wall = Wall(side, size)
    for along_m in (-0.4, 0.4):
        place = wall.at(along_m * wall.width_m, 1.0, 0.1)
        assert (place > 0).all()
        assert (place < size).all()
        assert np.isclose(np.minimum(place, size - place)[:2].min(), 0.1)
    # Seen from inside, with z up.
    np.testing.assert_allclose(np.cross(wall.right, [0.0, 0.0, 1.0]), -wall.inward, atol=1e-12)


def test_every_view_of_the_walk_has_contrast_to_see(room):
    atlas = texture_atlas(room.textures, grey=True)
    motion = walk_in_room(room.bounds_m, np.random.default_rng(0))
    poses = motion.poses(np.arange(0, 7_000_000, 1_000_000))
    for i in range(len(poses)):
        log_grey = np.log(render(room, atlas, poses[i], K, SIZE, SIZE)[..., 0])
        edges = np.abs(np.diff(log_grey, axis=1)) > 0.2
        assert edges.sum() > SIZE


def test_equal_seeds_give_equal_rooms_and_others_do_not():
    first, same, other = (furnished_room(np.random.default_rng(seed)) for seed in (4, 4, 5))
    np.testing.assert_array_equal(first.triangles, same.triangles)
    for a, b in zip(first.textures, same.textures, strict=True):
        np.testing.assert_array_equal(a, b)
    assert (first.bounds_m != other.bounds_m).any()


def test_the_cube_has_side_ten_about_the_origin():
    cube = grid_cube()
    np.testing.assert_allclose(cube.bounds_m, [[-5.0] * 3, [5.0] * 3], atol=1e-12)
    assert cube.triangles.shape == (12, 3, 3)


def test_each_face_of_the_cube_shows_two_by_two_cells():
    cube = grid_cube()
    atlas = texture_atlas(cube.textures, grey=True)
    for rotation in FACE_ROTATIONS:
        pose = SE3(rotation=rotation, translation=-25.0 * rotation[:, 2])
        # The face is 20 from the camera and fills the view.
        size = 96
        focal_px = size * 20.0 / 10.0
        view_K = np.array(
            [[focal_px, 0, (size - 1) / 2], [0, focal_px, (size - 1) / 2], [0, 0, 1.0]]
        )
        grey = render(cube, atlas, pose, view_K, size, size)[..., 0]
        for line in (grey[size // 4], grey[:, size // 4]):
            dark = line < 0.5 * line.max()
            runs = np.flatnonzero(np.diff(np.concatenate([[False], dark, [False]]).astype(int)) > 0)
            # A line at each rim and one in the middle.
            assert len(runs) == 3
            assert abs(runs[1] - size / 2) < 4
