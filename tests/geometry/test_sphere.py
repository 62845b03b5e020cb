import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from py360convert import e2c

from roel_service.geometry.sphere import (
    circle_distance_rad,
    great_circle_normal,
    pixel_from_ray,
    ray_from_pixel,
    sample_arc,
)
from roel_service.geometry.vectors import angle_between

from .strategies import arrays, points, unit_vectors

WIDTH, HEIGHT = 64, 32
X, Y, Z = np.eye(3)


@pytest.mark.parametrize(
    ("uv_px", "ray"),
    [
        ((WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5), X),  # centre of the image: forward
        ((WIDTH / 4 - 0.5, HEIGHT / 2 - 0.5), Y),  # left quarter: left
        ((3 * WIDTH / 4 - 0.5, HEIGHT / 2 - 0.5), -Y),
        ((-0.5, HEIGHT / 2 - 0.5), -X),  # left edge: the seam, behind
    ],
)
def test_axes_meet_the_image_where_the_convention_says(uv_px, ray):
    np.testing.assert_allclose(ray_from_pixel(np.array(uv_px), WIDTH, HEIGHT), ray, atol=1e-15)
    np.testing.assert_allclose(pixel_from_ray(ray, WIDTH, HEIGHT), uv_px, atol=1e-14)


@pytest.mark.parametrize(("row", "pole"), [(-0.5, Z), (HEIGHT - 0.5, -Z)])
def test_poles_lie_half_a_pixel_outside_the_image_and_have_one_ray(row, pole):
    columns = np.linspace(0, WIDTH - 1, 5)
    rays = ray_from_pixel(np.stack([columns, np.full(5, row)], axis=-1), WIDTH, HEIGHT)
    np.testing.assert_allclose(rays, np.broadcast_to(pole, (5, 3)), atol=1e-15)
    np.testing.assert_allclose(pixel_from_ray(pole, WIDTH, HEIGHT), [WIDTH / 2 - 0.5, row])


@given(arrays((6, 2), 0.0, 1.0))
def test_pixels_round_trip(fractions):
    # Rows from 0 on: at the pole itself the column is lost.
    uv_px = fractions * [WIDTH - 0.51, HEIGHT - 1]
    rays = ray_from_pixel(uv_px, WIDTH, HEIGHT)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1.0, rtol=1e-15)
    # The first row is 0.05 rad from the pole: roundings of the ray grow 20 times, then 64/2pi px.
    np.testing.assert_allclose(pixel_from_ray(rays, WIDTH, HEIGHT), uv_px, rtol=0, atol=1e-12)


@given(unit_vectors((5,)), st.floats(0.1, 100.0))
def test_rays_round_trip_at_any_length(rays, scale):
    back = ray_from_pixel(pixel_from_ray(scale * rays, WIDTH, HEIGHT), WIDTH, HEIGHT)
    np.testing.assert_allclose(back, rays, rtol=0, atol=1e-14)


@given(points((5,)))
def test_columns_stay_within_the_image(rays):
    uv_px = pixel_from_ray(rays, WIDTH, HEIGHT)
    assert ((uv_px[:, 0] >= -0.5) & (uv_px[:, 0] < WIDTH - 0.5)).all()
    assert ((uv_px[:, 1] >= -0.5) & (uv_px[:, 1] <= HEIGHT - 0.5)).all()


@pytest.mark.parametrize("azimuth_rad", [np.pi, -np.pi, np.pi - 1e-12, -np.pi + 1e-12])
def test_both_sides_of_the_seam_are_neighbours(azimuth_rad):
    ray = np.array([np.cos(azimuth_rad), np.sin(azimuth_rad), 0.0])
    column = pixel_from_ray(ray, WIDTH, HEIGHT)[0]
    gap = abs(column + 0.5)
    assert min(gap, WIDTH - gap) < 1e-10


def test_negative_zero_does_not_leave_the_image():
    assert pixel_from_ray(np.array([-1.0, -0.0, 0.0]), WIDTH, HEIGHT)[0] == -0.5


def test_columns_past_the_seam_come_round():
    uv_px = np.array([3.0, 10.0])
    np.testing.assert_allclose(
        ray_from_pixel(uv_px + np.array([WIDTH, 0]), WIDTH, HEIGHT),
        ray_from_pixel(uv_px, WIDTH, HEIGHT),
        atol=1e-14,
    )


def test_forward_view_agrees_with_an_independent_library():
    # A panorama whose value is its own azimuth and elevation, sampled by py360convert's front face.
    width, height, face = 512, 256, 64
    rows, columns = np.mgrid[:height, :width]
    rays = ray_from_pixel(np.stack([columns, rows], axis=-1), width, height)
    front = e2c(rays, face_w=face, mode="bilinear", cube_format="dict")["F"]
    # Axes of the face: y left over x, z up over x, both from +1 to -1 at its outer edges.
    ticks = 1.0 - 2.0 * np.arange(face) / (face - 1)
    inner = slice(8, -8)
    # py360convert puts the outermost pixel centres on the edges of the face.
    y_over_x = (front[..., 1] / front[..., 0])[inner, inner]
    z_over_x = (front[..., 2] / front[..., 0])[inner, inner]
    # Bilinear interpolation of a ray over one pixel of 2 pi/512 is off by its square over 8.
    np.testing.assert_allclose(y_over_x, np.broadcast_to(ticks[inner], (48, 48)), atol=0.02)
    np.testing.assert_allclose(
        z_over_x, np.broadcast_to(ticks[inner][:, None], (48, 48)), atol=0.02
    )


def test_remapping_with_the_mapping_turns_a_panorama_about_its_vertical():
    width, height, shift = 64, 32, 16
    image = np.random.default_rng(2).random((height, width)).astype(np.float32)
    rows, columns = np.mgrid[:height, :width]
    rays = ray_from_pixel(np.stack([columns, rows], axis=-1), width, height)
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # x to y: a turn to the left
    uv_px = pixel_from_ray(rays @ quarter.T, width, height).astype(np.float32)
    turned = cv2.remap(
        image, uv_px[..., 0], uv_px[..., 1], cv2.INTER_NEAREST, borderMode=cv2.BORDER_WRAP
    )
    np.testing.assert_array_equal(turned, np.roll(image, shift, axis=1))


@given(unit_vectors(), unit_vectors())
def test_great_circle_passes_its_two_rays(ray_1, ray_2):
    sine = np.linalg.norm(np.cross(ray_1, ray_2))
    assume(sine > 1e-3)
    distance_rad = circle_distance_rad(np.stack([ray_1, ray_2]), great_circle_normal(ray_1, ray_2))
    np.testing.assert_allclose(distance_rad, 0.0, atol=2e-15 / sine)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_equal_and_opposite_rays_have_no_great_circle(sign):
    assert np.isnan(great_circle_normal(X, sign * X)).all()


@pytest.mark.parametrize("angle_rad", [0.0, 1e-9, 0.2, np.pi / 2])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_circle_distance_is_the_elevation_above_the_circle(angle_rad, side):
    ray = np.array([np.cos(angle_rad), 0.0, side * np.sin(angle_rad)])
    assert circle_distance_rad(ray, Z) == pytest.approx(angle_rad, abs=3e-16)


@given(unit_vectors(), unit_vectors(), st.integers(2, 9))
def test_arc_is_sampled_at_equal_angles_on_its_circle(ray_1, ray_2, count):
    assume(np.linalg.norm(np.cross(ray_1, ray_2)) > 1e-6)
    arc = sample_arc(ray_1, ray_2, count)
    assert arc.shape == (count, 3)
    np.testing.assert_allclose(np.linalg.norm(arc, axis=-1), 1.0, rtol=1e-14)
    # The circle is known to the rounding of the rays, 1e-16, over the sine of their angle, 1e-6.
    np.testing.assert_allclose(arc[[0, -1]], [ray_1, ray_2], rtol=0, atol=1e-9)
    step_rad = angle_between(ray_1, ray_2) / (count - 1)
    np.testing.assert_allclose(angle_between(arc[:-1], arc[1:]), step_rad, rtol=0, atol=1e-9)


def test_arc_between_equal_rays_stands_still_and_between_opposite_rays_is_nan():
    arcs = sample_arc(np.stack([X, X]), np.stack([X, -X]), 4)
    np.testing.assert_array_equal(arcs[0], np.tile(X, (4, 1)))
    assert np.isnan(arcs[1]).all()
