import numpy as np
import pytest

from roel_service.simulate import textures
from roel_service.simulate.render import SAMPLE_OFFSETS, render, render_depth
from roel_service.simulate.rooms import SceneBuilder
from roel_service.simulate.scenes import Scene, texture_atlas

from .samples import BRIGHT, DARK, DEPTH_M, FOCAL_PX, HEIGHT, WIDTH, K, at, unlit, wall_with_edge


def picture(scene: Scene, x_m: float = 0.0, y_m: float = 0.0) -> np.ndarray:
    atlas = texture_atlas(scene.textures, grey=True)
    return render(scene, atlas, at(x_m, y_m, 0.0), K, WIDTH, HEIGHT)[..., 0]


def rectangle(build: SceneBuilder, depth_m: float, half_m: float, grey: float) -> None:
    corners = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]) * half_m
    colour = build.texture(textures.plain(np.full(3, grey)))
    build.quad(np.column_stack([corners, np.full(4, depth_m)]), colour)


def test_every_row_and_column_of_the_sample_grid_holds_one_sample():
    places = np.sort(SAMPLE_OFFSETS, axis=0)
    expected = (np.arange(len(places)) + 0.5) / len(places) - 0.5
    np.testing.assert_allclose(places, np.stack([expected, expected], axis=1), atol=1e-12)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("shift_px", [-0.45, -0.2, 0.0, 0.13, 0.31, 0.5])
def test_the_sum_of_a_row_tells_where_the_edge_is(axis, shift_px):
    normal = np.eye(2)[axis]
    shift_m = -shift_px * DEPTH_M / FOCAL_PX
    grey = picture(wall_with_edge(normal), *(shift_m * normal))
    size = (WIDTH, HEIGHT)[axis]
    dark_px = ((BRIGHT - grey) / (BRIGHT - DARK)).sum(axis=1 - axis)
    # Left of the edge at (size - 1) / 2 + shift lie size / 2 + shift pixels, to half a sample.
    assert np.abs(dark_px - (size / 2 + shift_px)).max() < 0.5 / len(SAMPLE_OFFSETS) + 1e-4


def test_the_triangles_of_a_rectangle_join_without_a_seam():
    build = SceneBuilder()
    rectangle(build, DEPTH_M, 10.0, 0.4)
    np.testing.assert_allclose(picture(unlit(build.scene())), 0.4, atol=1e-6)


def test_the_nearer_surface_hides_the_farther_in_any_order():
    for depths in ((1.0, 3.0), (3.0, 1.0)):
        build = SceneBuilder()
        for depth_m in depths:
            rectangle(build, depth_m, 10.0, 0.2 * depth_m)
        np.testing.assert_allclose(picture(unlit(build.scene())), 0.2, atol=1e-6)


def test_what_hits_nothing_is_background_at_infinite_depth():
    build = SceneBuilder()
    rectangle(build, -DEPTH_M, 10.0, 0.9)
    scene = build.scene()
    np.testing.assert_allclose(picture(scene), scene.background, atol=1e-6)
    assert np.isinf(render_depth(scene, at(0, 0, 0), K, WIDTH, HEIGHT)).all()


def test_a_floor_that_passes_under_the_camera_has_its_analytic_depth():
    build = SceneBuilder()
    below_m = 1.3
    floor = np.array([[-9.0, below_m, -9], [9, below_m, -9], [9, below_m, 9], [-9, below_m, 9]])
    build.quad(floor, build.texture(textures.plain(np.full(3, 0.5))))
    depth_m = render_depth(build.scene(), at(0, 0, 0), K, WIDTH, HEIGHT)
    slope = (np.arange(HEIGHT) - K[1, 2]) / FOCAL_PX
    expected = np.where(slope > 0, below_m / np.where(slope > 0, slope, 1.0), np.inf)
    reached = expected < 9.0
    assert np.isinf(depth_m[~reached]).all()
    # Metres; linear interpolation of 1/z in float64 over some hundred pixels.
    wanted = np.broadcast_to(expected[reached][:, None], depth_m[reached].shape)
    np.testing.assert_allclose(depth_m[reached], wanted, rtol=1e-9)


def test_a_texture_appears_upright_and_in_perspective():
    image = np.zeros((2, 2, 3), np.float32)
    image[0, 1] = 1.0
    build = SceneBuilder()
    # Lower left first, turning left, with camera axes: y points down.
    corners = np.array([[-1.0, 1, DEPTH_M], [1, 1, DEPTH_M], [1, -1, DEPTH_M], [-1, -1, DEPTH_M]])
    build.quad(corners, build.texture(image))
    grey = picture(unlit(build.scene()))
    reach = int(0.5 * FOCAL_PX / DEPTH_M)
    row, column = HEIGHT // 2, WIDTH // 2
    # The middles of the four texels.
    assert grey[row - reach, column + reach] > 0.9
    for down, right in ((-1, -1), (1, -1), (1, 1)):
        assert grey[row + down * reach, column + right * reach] < 0.1


def test_a_fine_pattern_far_away_fades_to_its_mean():
    board = np.indices((64, 64)).sum(axis=0) % 2
    image = np.repeat(board[..., None], 3, axis=2).astype(np.float32)
    build = SceneBuilder()
    corners = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]) * 20.0
    build.quad(np.column_stack([corners, np.full(4, 20.0)]), build.texture(image), (20.0, 20.0))
    # 64 x 20 texels on 120 pixels: ten a pixel, nothing of the pattern may be left.
    np.testing.assert_allclose(picture(unlit(build.scene())), 0.5, atol=0.01)
