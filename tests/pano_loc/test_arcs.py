import numpy as np
import pytest

from roel_service.config.stages import LocalizeConfig
from roel_service.geometry import sphere
from roel_service.geometry.se3 import rotation_from_vector
from roel_service.geometry.vectors import unit
from roel_service.pano_loc.arcs import TILING, PanoramaArcs, crops, detect_arcs, join_arcs

WIDTH = 1024
# Corners of a window in front of the viewer, in order; and the same elsewhere.
WINDOW = unit(np.array([[1.0, 0.5, 0.4], [1.0, -0.5, 0.4], [1.0, -0.5, -0.4], [1.0, 0.5, -0.4]]))
TURNS = {
    "in front": (0.0, 0.0, 0.3),
    "across the seam": (0.1, 0.0, np.pi),
    "around a pole": (0.0, -np.pi / 2, 0.4),
}
WINDOWS = {name: WINDOW @ rotation_from_vector(np.array(turn)).T for name, turn in TURNS.items()}


def picture_of(windows, width):
    """White windows on dark ground, each pixel averaged over 2 x 2 points."""
    columns, rows = np.meshgrid(np.arange(2 * width), np.arange(width))
    rays = sphere.ray_from_pixel(np.stack([columns, rows], axis=-1), 2 * width, width)
    white = np.zeros(rays.shape[:2], bool)
    for corners in windows:
        across = np.cross(np.roll(corners, -1, axis=0), corners)
        white |= (rays @ across.T > 0).all(axis=-1)
    mean = white.reshape(width // 2, 2, width, 2).mean(axis=(1, 3))
    return (40 + 160 * mean).astype(np.uint8)


@pytest.fixture(scope="module")
def arcs():
    return detect_arcs(picture_of(WINDOWS.values(), WIDTH), LocalizeConfig())


def test_nothing_but_the_windows_is_seen(arcs):
    assert len(arcs) == 4 * len(WINDOWS)


@pytest.mark.parametrize("name", WINDOWS)
def test_each_side_of_a_window_is_one_arc_wherever_it_lies(arcs, name):
    corners = WINDOWS[name]
    expected = sphere.great_circle_normal(corners, np.roll(corners, -1, axis=0))
    cosine = np.abs(expected @ arcs.normals.T)
    # A tenth of a degree; a pixel of the panorama is 0.35 degrees.
    assert np.degrees(np.arccos(np.minimum(cosine.max(axis=1), 1.0))).max() < 0.1
    length = np.arccos(np.sum(corners * np.roll(corners, -1, axis=0), axis=1))
    np.testing.assert_allclose(arcs.length_rad[cosine.argmax(axis=1)], length, atol=0.05)


def test_a_blank_picture_has_no_arcs():
    assert len(detect_arcs(np.full((256, 512), 90, np.uint8), LocalizeConfig())) == 0


def test_large_pictures_are_made_smaller_first():
    config = LocalizeConfig(max_width_px=512, crop_px=96)
    picture = picture_of(WINDOWS.values(), 512)
    small = detect_arcs(picture, config)
    limited = detect_arcs(np.kron(picture, np.ones((2, 2), np.uint8)), config)
    assert len(small) > 0
    np.testing.assert_array_equal(limited.normals, small.normals)


def test_pieces_of_a_line_are_joined_and_other_lines_are_not():
    line = sphere.sample_arc(WINDOW[None, 0], WINDOW[None, 1], 6)[0]
    other = sphere.sample_arc(WINDOW[None, 2], WINDOW[None, 3], 2)[0]
    starts, ends = np.concatenate([line[:-1], other[:1]]), np.concatenate([line[1:], other[1:]])
    arcs = join_arcs(PanoramaArcs.between(starts, ends))
    assert len(arcs) == 2
    whole = np.arccos([WINDOW[0] @ WINDOW[1], WINDOW[2] @ WINDOW[3]])
    np.testing.assert_allclose(np.sort(arcs.length_rad), np.sort(whole), atol=1e-9)


def test_a_gap_parts_two_lines_on_one_circle():
    line = sphere.sample_arc(WINDOW[None, 0], WINDOW[None, 1], 9)[0]
    arcs = join_arcs(PanoramaArcs.between(line[[0, 6]], line[[2, 8]]))
    assert len(arcs) == 2


def test_crops_cover_the_sphere():
    rays = unit(np.random.default_rng(0).normal(size=(2000, 3)))
    seen = np.zeros(len(rays), bool)
    for crop in crops(WIDTH, 64, TILING):
        x, y, z = (rays @ crop.R_panorama_camera).T
        with np.errstate(divide="ignore", invalid="ignore"):
            place = crop.center_px + crop.focal_px * np.stack([x / z, y / z])
        seen |= (z > 0) & (np.abs(place - crop.center_px) <= crop.center_px).all(axis=0)
    assert seen.all()
