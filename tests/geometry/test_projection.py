import dataclasses

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from roel_service.geometry.plucker import plucker_from_endpoints
from roel_service.geometry.projection import (
    CameraModel,
    clip_to_depth,
    distort,
    fundamental_matrix,
    image_line_from_moment,
    normalized_from_pixel,
    pixel_from_normalized,
    project,
    ray_from_pixel,
    undistort,
    undistortion_table,
    viewing_plane_normal,
)
from roel_service.scene.camera import Camera

from .strategies import arrays, central_difference, points, poses

PINHOLE = Camera(width=64, height=48, fx_px=40.0, fy_px=41.0, cx_px=31.0, cy_px=23.5)
K = PINHOLE.matrix
# Lenses like those of real event cameras: barrel, with tangential part, rational, fisheye.
LENSES = {
    "four": (CameraModel.PINHOLE, (-0.368, 0.151, -0.0003, -0.0004)),
    "five": (CameraModel.PINHOLE, (-0.095, 0.085, 0.001, -0.002, -0.03)),
    "eight": (CameraModel.PINHOLE, (0.9, 0.3, 1e-3, -5e-4, 0.01, 1.1, 0.45, 0.05)),
    "fisheye": (CameraModel.FISHEYE, (-0.031, 0.012, -0.006, 0.001)),
}
lenses = pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES.keys())


def with_lens(camera, lens):
    model, distortion = lens
    return dataclasses.replace(camera, model=model, distortion=distortion)


def opencv_distort(xy, lens):
    model, coefficients = lens
    rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=-1)[:, None]
    project_points = (
        cv2.projectPoints if model is CameraModel.PINHOLE else cv2.fisheye.projectPoints
    )
    zero = np.zeros((1, 1, 3))
    return project_points(rays, zero, zero, np.eye(3), np.array(coefficients))[0].reshape(-1, 2)


def opencv_undistort(xy, lens):
    model, coefficients = lens
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 1000, 1e-14)
    if model is CameraModel.PINHOLE:
        ideal = cv2.undistortPointsIter(
            xy[:, None], np.eye(3), np.array(coefficients), None, np.eye(3), stop
        )
    else:
        ideal = cv2.fisheye.undistortPoints(
            xy[:, None], np.eye(3), np.array(coefficients), criteria=stop
        )
    return ideal.reshape(-1, 2)


def grid(half_width=0.6, count=15):
    ticks = np.linspace(-half_width, half_width, count)
    return np.stack(np.meshgrid(ticks, 0.7 * ticks), axis=-1).reshape(-1, 2)


@lenses
def test_distortion_agrees_with_opencv(lens):
    # Normalized coordinates below 1, evaluated in two orders of the same sums.
    np.testing.assert_allclose(distort(grid(), *lens), opencv_distort(grid(), lens), atol=1e-14)


@lenses
def test_undistortion_agrees_with_opencv(lens):
    # OpenCV stops at 1e-14 in its own measure; ours at 1e-10 before a last quadratic step.
    np.testing.assert_allclose(undistort(grid(), *lens), opencv_undistort(grid(), lens), atol=1e-9)


@lenses
@given(xy=arrays((7, 2), -0.55, 0.55))
def test_undistort_undoes_distort(lens, xy):
    # The slope of these lenses is above 0.4 here: the residual of 1e-10 grows at most to 2.5e-10.
    np.testing.assert_allclose(undistort(distort(xy, *lens), *lens), xy, rtol=0, atol=3e-10)


@lenses
def test_batch_axes_do_not_change_the_result(lens):
    flat = undistort(grid(count=6), *lens)
    np.testing.assert_allclose(
        undistort(grid(count=6).reshape(6, 6, 2), *lens).reshape(-1, 2), flat, rtol=0, atol=1e-12
    )
    np.testing.assert_allclose(undistort(grid(count=6)[8], *lens), flat[8], rtol=0, atol=1e-12)


@pytest.mark.parametrize("model", CameraModel)
def test_no_coefficients_leave_rays_as_they_are(model):
    np.testing.assert_array_equal(distort(grid(), model, ()), grid())
    np.testing.assert_array_equal(undistort(grid(), model, ()), grid())


@lenses
def test_optical_axis_is_a_fixed_point(lens):
    axis = np.zeros((1, 2))
    np.testing.assert_array_equal(distort(axis, *lens), axis)
    np.testing.assert_array_equal(undistort(axis, *lens), axis)


def test_radial_polynomial_is_followed_only_up_to_its_fold():
    k1 = -0.3
    fold = np.sqrt(-1 / (3 * k1))  # where d/dr (r + k1 r^3) = 0
    peak = fold * (1 + k1 * fold**2)
    radius = np.array([0.5 * peak, 0.999 * peak, 1.001 * peak, 2 * peak])
    ideal = undistort(
        np.stack([0.6 * radius, 0.8 * radius], -1), CameraModel.PINHOLE, (k1, 0, 0, 0)
    )
    found = np.linalg.norm(ideal, axis=-1)
    assert (found[:2] < fold).all()
    np.testing.assert_allclose(found[:2] * (1 + k1 * found[:2] ** 2), radius[:2], atol=1e-10)
    assert np.isnan(found[2:]).all()


def test_pole_of_the_rational_model_bounds_the_image():
    lens = (CameraModel.PINHOLE, (0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0))  # r / (1 - r^2)
    ideal = undistort(np.array([[0.1, 0.0], [1e3, 0.0]]), *lens)
    assert (np.linalg.norm(ideal, axis=-1) < 1.0).all()
    np.testing.assert_allclose(distort(ideal, *lens), [[0.1, 0.0], [1e3, 0.0]], atol=1e-9)


def test_fisheye_rays_at_right_angles_to_the_axis_have_no_pinhole_pixel():
    angle_rad = np.radians([10.0, 89.0, 90.0, 100.0])
    xy = np.stack([angle_rad, np.zeros(4)], axis=-1)  # no distortion: image radius = angle
    ideal = undistort(xy, CameraModel.FISHEYE, (0.0, 0.0, 0.0, 0.0))
    np.testing.assert_allclose(ideal[:2, 0], np.tan(angle_rad[:2]), rtol=1e-9)
    assert np.isnan(ideal[2:]).all()


def test_fisheye_fold_is_refused():
    k1 = -0.5  # theta - theta^3/2 peaks at sqrt(2/3) rad with 0.5443
    ideal = undistort(np.array([[0.54, 0.0], [0.55, 0.0]]), CameraModel.FISHEYE, (k1, 0, 0, 0))
    assert np.arctan(ideal[0, 0]) < np.sqrt(2 / 3)
    assert np.isnan(ideal[1]).all()


@lenses
def test_table_holds_the_ideal_pixel_of_every_raw_pixel(lens):
    camera = with_lens(PINHOLE, lens)
    table = undistortion_table(camera)
    assert table.shape == (48, 64, 2)
    assert table.dtype == np.float32
    column, row = 50, 12
    xy = normalized_from_pixel(table[row, column].astype(float), K)
    raw_px = pixel_from_normalized(distort(xy, *lens), K)
    # float32 resolves 4e-6 px at 64 px.
    np.testing.assert_allclose(raw_px, [column, row], atol=1e-5)


def test_table_of_an_ideal_camera_is_the_pixel_grid():
    table = undistortion_table(PINHOLE)
    np.testing.assert_array_equal(table[7, 11], [11, 7])
    np.testing.assert_array_equal(table[-1, -1], [63, 47])


def test_table_marks_pixels_without_a_ray():
    camera = with_lens(PINHOLE, (CameraModel.PINHOLE, (-0.6, 0.0, 0.0, 0.0)))
    table = undistortion_table(camera)
    assert np.isnan(table[0, 0]).all()
    assert np.isfinite(table[24, 31]).all()


@given(arrays((5, 2), -100, 200))
def test_normalized_coordinates_round_trip(xy_px):
    back = pixel_from_normalized(normalized_from_pixel(xy_px, K), K)
    np.testing.assert_allclose(back, xy_px, rtol=0, atol=1e-12)


@given(arrays((5, 2), -100, 200), st.floats(0.01, 100.0))
def test_project_undoes_unproject_at_any_depth(xy_px, depth_m):
    rays = ray_from_pixel(xy_px, K)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1.0, rtol=1e-15)
    np.testing.assert_allclose(project(depth_m * rays, K), xy_px, rtol=0, atol=1e-11)


def test_axes_are_right_down_forward():
    ahead, right, below = np.array([[0.0, 0, 1], [0.1, 0, 1], [0, 0.1, 1]])
    np.testing.assert_array_equal(project(ahead, K), [31.0, 23.5])
    assert project(right, K)[0] > 31.0
    assert project(below, K)[1] > 23.5


def test_points_at_or_behind_the_camera_have_no_pixel():
    pixels = project(np.array([[0.1, 0, 0.0], [0.1, 0, -1.0], [0.1, 0, 1.0]]), K)
    assert np.isnan(pixels[:2]).all()
    assert np.isfinite(pixels[2]).all()


def test_segments_are_cut_at_the_near_plane():
    a, b = [0.0, 0.0, -1.0], [2.0, 4.0, 1.0]
    clipped = clip_to_depth(np.array([[a, b], [b, a], [b, b], [a, a]]), 0.5)
    cut = [1.5, 3.0, 0.5]
    np.testing.assert_allclose(clipped[:3], [[cut, b], [b, cut], [b, b]], rtol=1e-15)
    assert np.isnan(clipped[3]).all()


def test_segment_parallel_to_the_image_is_kept_or_lost_as_a_whole():
    segment = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0]])
    np.testing.assert_array_equal(clip_to_depth(segment, 0.5), segment)
    assert np.isnan(clip_to_depth(segment, 2.0)).all()


@given(arrays((2, 2), 0, 60).filter(lambda s: np.linalg.norm(s[1] - s[0]) > 1))
def test_viewing_plane_holds_every_ray_of_its_segment(segment_px):
    normal = viewing_plane_normal(segment_px, K)
    fraction = np.linspace(-1, 2, 7)[:, None]
    on_line_px = segment_px[0] + fraction * (segment_px[1] - segment_px[0])
    np.testing.assert_allclose(ray_from_pixel(on_line_px, K) @ normal, 0.0, atol=1e-13)


def test_segment_of_zero_length_has_no_viewing_plane():
    assert np.isnan(viewing_plane_normal(np.full((2, 2), 3.0), K)).all()


@given(arrays((2, 3), -1, 1).filter(lambda s: np.linalg.norm(s[1] - s[0]) > 0.1))
def test_image_line_passes_the_projected_points(ends):
    ends = ends + np.array([0, 0, 3.0])
    _, moment = plucker_from_endpoints(ends)
    assume(np.linalg.norm(moment) > 1e-3)  # a line seen end-on is a point, tested below
    line = image_line_from_moment(moment, K)
    on_line_px = project(ends, K)
    # Rounding of the moment, 1e-15, over its smallest length, 1e-3, times 100 px.
    np.testing.assert_allclose(on_line_px @ line[:2] + line[2], 0.0, atol=1e-9)
    assert np.linalg.norm(line[:2]) == pytest.approx(1.0, rel=1e-14)


def test_lines_without_an_image_are_nan():
    through_centre = np.zeros(3)
    in_focal_plane = np.array([0.0, 0.0, 2.0])
    assert np.isnan(image_line_from_moment(np.stack([through_centre, in_focal_plane]), K)).all()


@given(points((6,), 2.0), poses(size_m=0.5, max_angle_rad=0.3))
def test_fundamental_matrix_relates_the_pixels_of_one_point(points_1, T_2_1):
    points_1 = points_1 + np.array([0, 0, 6.0])
    K_2 = np.diag([1.5, 1.5, 1.0]) @ K
    F = fundamental_matrix(K, K_2, T_2_1)
    x_1 = np.concatenate([project(points_1, K), np.ones((6, 1))], axis=-1)
    x_2 = np.concatenate([project(T_2_1 @ points_1, K_2), np.ones((6, 1))], axis=-1)
    # |x| < 1e3, |F| < 1: products of 1e6 rounded at 1e-16 each.
    np.testing.assert_allclose(np.einsum("ki,ij,kj->k", x_2, F, x_1), 0.0, atol=1e-9)


@pytest.mark.parametrize("name", ["four", "five", "eight"])
@pytest.mark.parametrize("point", [(0.0, 0.0), (0.3, -0.2), (0.5, 0.4)])
def test_slope_of_undistort_inverts_the_slope_of_distort(name, point):
    lens = LENSES[name]
    point = np.array(point)
    forward = central_difference(lambda delta: distort(point + delta, *lens), 2, 1e-6)
    distorted = distort(point, *lens)
    backward = central_difference(lambda delta: undistort(distorted + delta, *lens), 2, 1e-4)
    # Second order of the step (1e-8) times the third derivative, and 1e-10 / 1e-4.
    np.testing.assert_allclose(backward @ forward, np.eye(2), atol=1e-5)
