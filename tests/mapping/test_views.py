import numpy as np
import pytest

from roel_service.geometry import plucker, projection, segments
from roel_service.mapping.views import cuts_m, end_residuals_px

from .synthetic import world


def test_viewing_planes_and_end_rays_hold_the_observed_segments():
    exact = world()
    views = exact.views
    ends = exact.segments[exact.line_of] - views.centre[:, None]
    np.testing.assert_allclose(np.vecdot(ends, views.normal[:, None]), 0, rtol=0, atol=1e-14)
    rays = ends / np.linalg.norm(ends, axis=-1, keepdims=True)
    np.testing.assert_allclose(views.end_rays, rays, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(views.length_px, segments.length(exact.observations.segments_px))


def test_cuts_of_exact_lines_are_their_ends():
    exact = world()
    lines = exact.lines.take(exact.line_of)
    arc_m, depth_m = cuts_m(exact.views, lines.direction, lines.moment)
    ends = exact.segments[exact.line_of]
    expected = plucker.arc_length(lines.direction[:, None], ends)
    np.testing.assert_allclose(arc_m, expected, rtol=0, atol=1e-13)
    T_camera_world = exact.frames.T_world_camera[exact.observations.frame].inverse()
    in_camera = T_camera_world[:, None] @ ends
    np.testing.assert_allclose(depth_m, in_camera[..., 2], rtol=0, atol=1e-13)


def test_cut_planes_stand_across_the_segment_in_the_image():
    exact = world()
    views, K = exact.views, exact.frames.K
    R = exact.frames.T_world_camera.rotation[views.frame]
    image_line = np.einsum("sji,sej->sei", R, views.cut_normal) @ np.linalg.inv(K)
    along = segments.span(views.segment_px)
    # The line's normal in the image is parallel to the segment.
    across = image_line[..., 0] * along[:, None, 1] - image_line[..., 1] * along[:, None, 0]
    scale = np.linalg.norm(image_line[..., :2], axis=-1) * views.length_px[:, None]
    np.testing.assert_allclose(across / scale, 0, rtol=0, atol=1e-12)


def test_residuals_of_exact_lines_vanish_and_grow_with_the_distance():
    exact = world()
    lines = exact.lines.take(exact.line_of)
    focal_px = exact.frames.focal_px
    residual = end_residuals_px(exact.views, lines.direction, lines.moment, focal_px)
    assert np.abs(residual).max() < 1e-11  # px
    beside = (
        exact.observations.segments_px
        + segments.left_normal(exact.observations.segments_px)[:, None]
    )
    moved = type(exact.observations)(**vars(exact.observations) | {"segments_px": beside})
    from_line = end_residuals_px(
        type(exact)(**vars(exact) | {"observations": moved}).views,
        lines.direction,
        lines.moment,
        focal_px,
    )
    # One px, as an angle times f: at 40 degrees off the axis 0.6 of it.
    assert ((np.abs(from_line) > 0.6) & (np.abs(from_line) <= 1.0 + 1e-9)).all()


def test_a_cut_parallel_to_the_line_is_nan():
    exact = world(lines=(0,))
    view = exact.views.take(slice(0, 1))
    within = view.cut_normal[0, 0]
    direction = np.cross(within, view.normal[0])
    direction /= np.linalg.norm(direction)
    moment = np.cross(view.centre[0] + view.axis[0], direction)
    arc_m, depth_m = cuts_m(view, direction[None], moment[None])
    assert np.isnan(arc_m[0, 0])
    assert np.isnan(depth_m[0, 0])


@pytest.mark.parametrize("index", [slice(3, 7), np.array([5, 2, 2]), [True] * 2 + [False] * 286])
def test_take_picks_the_same_rows_of_all(index):
    views = world().views
    picked = views.take(index)
    for name, values in vars(views).items():
        np.testing.assert_array_equal(getattr(picked, name), values[index])


def test_views_of_a_line_and_its_projection_agree():
    exact = world()
    T_camera_world = exact.frames.T_world_camera[exact.observations.frame].inverse()
    projected = projection.project(
        T_camera_world[:, None] @ exact.segments[exact.line_of], exact.frames.K
    )
    np.testing.assert_allclose(exact.views.segment_px, projected, rtol=0, atol=1e-11)
