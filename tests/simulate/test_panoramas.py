import numpy as np
import pytest

from roel_service.geometry import sphere
from roel_service.geometry.se3 import SE3, rotation_from_vector
from roel_service.simulate import textures
from roel_service.simulate.panoramas import render_panorama
from roel_service.simulate.rooms import BOX_FACES, SceneBuilder
from roel_service.simulate.scenes import Scene, texture_atlas

from .samples import unlit

WIDTH, HEIGHT = 128, 64
GREYS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)


def coloured_box() -> Scene:
    """A cube around the origin, its sides +x -x +y -y +z -z with `GREYS`."""
    build = SceneBuilder()
    for corners, grey in zip(BOX_FACES, GREYS, strict=True):
        build.quad(3.0 * corners, build.texture(textures.plain(np.full(3, grey))))
    return unlit(build.scene())


def panorama(scene: Scene, pose: SE3) -> np.ndarray:
    return render_panorama(scene, texture_atlas(scene.textures, grey=True), pose, WIDTH)[..., 0]


@pytest.mark.parametrize(
    "turn", [np.zeros(3), np.array([0.0, 0.0, 1.1]), np.array([0.2, -0.3, 2.0])]
)
def test_every_pixel_shows_the_side_that_its_ray_hits(turn):
    pose = SE3(rotation=rotation_from_vector(turn), translation=np.zeros(3))
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = pose.rotate(sphere.ray_from_pixel(np.stack([columns, rows], axis=-1), WIDTH, HEIGHT))
    axis = np.argmax(np.abs(rays), axis=-1)
    largest = np.take_along_axis(rays, axis[..., None], axis=-1)[..., 0]
    expected = np.array(GREYS)[2 * axis + (largest < 0)]
    # Away from the box's edges by a pixel's angle and some.
    second = np.sort(np.abs(rays), axis=-1)[..., 1]
    clear = np.abs(largest) - second > 2 * np.pi / HEIGHT
    assert clear.mean() > 0.7
    np.testing.assert_allclose(panorama(coloured_box(), pose)[clear], expected[clear], atol=1e-5)


def test_forward_is_in_the_middle_left_is_left_and_up_is_up():
    picture = panorama(coloured_box(), SE3.identity())
    middle = HEIGHT // 2
    columns = [WIDTH // 2, 0, WIDTH // 4, 3 * WIDTH // 4]
    np.testing.assert_allclose(picture[middle, columns], GREYS[:4], atol=1e-5)
    np.testing.assert_allclose(picture[[0, -1], 5], GREYS[4:], atol=1e-5)


@pytest.mark.parametrize(
    ("azimuth_deg", "elevation_deg"), [(10, 5), (-95, 33), (178.5, -20), (45, 60), (-44, -35)]
)
def test_a_spot_appears_where_its_ray_belongs(azimuth_deg, elevation_deg):
    azimuth, elevation = np.deg2rad([azimuth_deg, elevation_deg])
    ray = np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    build = SceneBuilder()
    white = build.texture(textures.plain(np.ones(3)))
    build.box(5.0 * ray, np.full(3, 0.7), white)
    box = build.scene()
    picture = panorama(
        Scene(
            triangles=box.triangles,
            uv=box.uv,
            texture=box.texture,
            brightness=np.ones(len(box.triangles), np.float32),
            textures=box.textures,
            background=0.0,
        ),
        SE3.identity(),
    )
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = sphere.ray_from_pixel(np.stack([columns, rows], axis=-1), WIDTH, HEIGHT)
    # Pixels near the poles are smaller.
    weight = picture * np.hypot(rays[..., 0], rays[..., 1])
    seen = (weight[..., None] * rays).sum(axis=(0, 1))
    angle = np.arccos(np.clip(seen @ ray / np.linalg.norm(seen), -1, 1))
    # A third of a pixel: the box is some three pixels wide, its outline is sampled.
    assert angle < 2 * np.pi / WIDTH / 3


def test_the_picture_closes_at_its_sides():
    build = SceneBuilder()
    soft = textures.mottled(np.full(3, 0.5), 0.1, 64, np.random.default_rng(0))
    for corners in BOX_FACES:
        build.quad(3.0 * corners, build.texture(soft))
    picture = panorama(unlit(build.scene()), SE3.identity())
    inside = np.abs(np.diff(picture, axis=1)).max()
    assert np.abs(picture[:, 0] - picture[:, -1]).max() <= 1.5 * inside
