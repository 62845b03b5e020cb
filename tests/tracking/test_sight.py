import numpy as np
import pytest

from roel_service.geometry import projection, segments
from roel_service.geometry.projection import undistortion_table
from roel_service.geometry.se3 import SE3, rotation_from_vector
from roel_service.scene.lines import LineMap
from roel_service.tracking.fit import View
from roel_service.tracking.pieces import pieces_of
from roel_service.tracking.sight import Eyes, glimpse, looking

from .synthetic import CAMERA, STEP_US, events_of, result_of, walls

AT_US = 40_000


@pytest.fixture(scope="module")
def eyes():
    return Eyes(
        camera=CAMERA,
        ideal_px=undistortion_table(CAMERA),
        view=View(K=CAMERA.matrix, width=CAMERA.width, height=CAMERA.height),
        pieces=pieces_of(LineMap.from_segments(walls(0))),
    )


@pytest.fixture(scope="module")
def turning():
    """A camera that turns on the spot by (3,) rad/s, and the events that it sees."""
    rate = np.array([0.3, -0.9, 0.4])
    t_us = np.arange(0, 80_000 + STEP_US, STEP_US)
    steps = (t_us - AT_US)[:, None] * 1e-6 * rate
    poses = SE3(rotation=rotation_from_vector(steps), translation=np.zeros((len(t_us), 3)))
    return rate, events_of(walls(0), t_us, poses, np.random.default_rng(1))


def test_lines_tell_how_fast_the_camera_turns(turning, eyes):
    rate, events = turning
    sight = glimpse(events, AT_US, eyes)
    assert np.linalg.norm(sight.turn_rate - rate) < 0.25 * np.linalg.norm(rate)


def test_with_the_turn_undone_speeds_are_those_that_the_camera_sees(turning, eyes):
    rate, events = turning
    lines = result_of(looking(events, AT_US, eyes, rate)).lines
    step_s = 1e-3
    turned = rotation_from_vector(step_s * rate)
    middle = segments.midpoint(lines.segments_px)
    later = projection.project(
        projection.ray_from_pixel(middle, CAMERA.matrix) @ turned, CAMERA.matrix
    )
    normal = segments.left_normal(lines.segments_px)
    expected_px_per_ms = 1e-3 * np.sum(normal * (later - middle), axis=1) / step_s
    off = np.abs(lines.normal_speed_px_per_ms - expected_px_per_ms)
    assert np.median(np.abs(expected_px_per_ms)) > 0.05
    assert np.median(off) < 0.1 * np.median(np.abs(expected_px_per_ms))


def test_nothing_in_sight_is_no_turn(eyes, turning):
    _, events = turning
    sight = glimpse(events.part(0, 1), AT_US, eyes)
    assert len(sight.lines.polarity) == 0
    np.testing.assert_array_equal(sight.turn_rate, np.zeros(3))
