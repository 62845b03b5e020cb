from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib._pylab_helpers import Gcf

from roel_service.arrays import FloatArray
from roel_service.evaluation.figures import (
    best_view,
    draw_map,
    event_image,
    plan_axes,
    round_length,
)
from roel_service.geometry.se3 import SE3, rotation_from_vector
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventStream
from roel_service.scene.lines import LineMap
from roel_service.scene.trajectory import Trajectory

CAMERA = Camera(
    width=64,
    height=48,
    fx_px=50.0,
    fy_px=50.0,
    cx_px=31.5,
    cy_px=23.5,
    distortion=(-0.3, 0.1, 0.0, 0.0),
)


def events(count: int = 2_000) -> EventStream:
    rng = np.random.default_rng(0)
    return EventStream(
        t_us=np.sort(rng.integers(0, 1_000_000, count)),
        x=rng.integers(0, CAMERA.width, count),
        y=rng.integers(0, CAMERA.height, count),
        polarity=rng.choice([-1, 1], count),
        width=CAMERA.width,
        height=CAMERA.height,
    )


def turning(angles_rad: FloatArray) -> SE3:
    """Cameras at the origin, turned about their y axis."""
    vectors = np.stack([np.zeros_like(angles_rad), angles_rad, np.zeros_like(angles_rad)], axis=1)
    return SE3(rotation=rotation_from_vector(vectors), translation=np.zeros((len(angles_rad), 3)))


def wall(distance_m: float) -> LineMap:
    """Five horizontal lines in front of the unturned camera."""
    y = np.linspace(-0.4, 0.4, 5) * distance_m
    start = np.stack([np.full(5, -0.4 * distance_m), y, np.full(5, distance_m)], axis=1)
    return LineMap.from_segments(np.stack([start, start * [-1, 1, 1]], axis=1))


def test_best_view_is_the_one_that_sees_the_lines() -> None:
    times_us = np.arange(41) * 1000
    angles_rad = np.linspace(-np.pi, np.pi, 41)
    view = best_view(wall(2.0), CAMERA, times_us, turning(angles_rad))
    assert view.t_us == 20_000
    assert view.is_seen.all()


def test_lines_behind_the_camera_are_not_seen() -> None:
    times_us = np.arange(11) * 1000
    view = best_view(wall(2.0), CAMERA, times_us, turning(np.full(11, np.pi)))
    assert not view.is_seen.any()
    assert view.seen_length_px == 0.0


def test_line_through_the_camera_plane_is_cut_there() -> None:
    line_map = LineMap.from_segments(np.array([[[0.1, 0.1, -3.0], [0.1, 0.1, 3.0]]]))
    view = best_view(line_map, CAMERA, np.arange(11) * 1000, turning(np.zeros(11)))
    pieces, depth_m = view.pieces
    assert len(pieces) > 0
    assert (depth_m > 0).all()


@pytest.mark.parametrize("distance_m", [0.01, 1.0, 1000.0])
def test_scene_of_any_size_is_seen_alike(distance_m: float) -> None:
    view = best_view(wall(distance_m), CAMERA, np.arange(11) * 1000, turning(np.zeros(11)))
    reference = best_view(wall(1.0), CAMERA, np.arange(11) * 1000, turning(np.zeros(11)))
    # The same rays up to the rounding of float64.
    np.testing.assert_allclose(view.pixels, reference.pixels, atol=1e-9)


def test_plan_of_level_cameras_in_a_z_up_world_is_x_right_y_up() -> None:
    level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    np.testing.assert_allclose(plan_axes(level[None]), np.eye(3)[:, :2], atol=1e-12)


def test_plan_of_cameras_that_define_the_world_shows_depth_upwards() -> None:
    np.testing.assert_allclose(plan_axes(np.eye(3)[None]), np.eye(3)[:, [0, 2]], atol=1e-12)


@pytest.mark.parametrize("tilt_rad", [0.0, 0.3, 0.7, 1.5])
def test_plan_is_a_right_handed_pair_of_unit_vectors(tilt_rad: float) -> None:
    plan = plan_axes(rotation_from_vector(np.array([[tilt_rad, 0.2, 0.1]])))
    np.testing.assert_allclose(plan.T @ plan, np.eye(2), atol=1e-12)


def test_events_near_the_moment_are_drawn_and_others_are_not() -> None:
    stream = EventStream(
        t_us=[0, 500_000, 999_999],
        x=[1, 2, 3],
        y=[4, 5, 6],
        polarity=[1, -1, 1],
        width=CAMERA.width,
        height=CAMERA.height,
    )
    image = event_image(stream, 500_000)
    coloured = np.argwhere((image < 1.0).any(axis=2))
    assert coloured.tolist() == [[5, 2]]


def test_moment_without_events_is_blank() -> None:
    assert (event_image(events(), 5_000_000) == 1.0).all()


@pytest.mark.parametrize(
    ("length", "rounded"), [(0.9, 0.5), (1.0, 1.0), (4.99, 2.0), (5.0, 5.0), (0.0123, 0.01)]
)
def test_scale_bar_has_a_round_length(length: float, rounded: float) -> None:
    assert round_length(length) == pytest.approx(rounded, rel=1e-12)


@pytest.mark.parametrize("line_count", [1, 5])
def test_picture_is_a_png_and_leaves_no_global_state(tmp_path: Path, line_count: int) -> None:
    trajectory = Trajectory(t_us=np.array([0, 1_000_000]), T_world_camera=turning(np.zeros(2)))
    line_map = LineMap.from_segments(wall(2.0).segments[:line_count])
    draw_map(line_map, trajectory, CAMERA, events(), tmp_path / "map.png")
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")
    assert Gcf.get_all_fig_managers() == []


def test_picture_of_a_map_that_is_never_in_view(tmp_path: Path) -> None:
    trajectory = Trajectory(t_us=np.array([0, 1_000_000]), T_world_camera=turning(np.full(2, 3.0)))
    draw_map(wall(2.0), trajectory, CAMERA, events(), tmp_path / "map.png")
    assert (tmp_path / "map.png").stat().st_size > 1_000
