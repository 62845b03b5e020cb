from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from roel_bench.peers import emvs, emvs_kernels
from roel_bench.peers.emvs import EmvsSettings, map_points
from roel_bench.peers.keyframes import KeyframeSettings, span_from
from roel_service.errors import ConfigError, EventsError, LimitError
from roel_service.geometry import se3
from roel_service.geometry.projection import project
from roel_service.geometry.se3 import SE3
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventStream
from roel_service.scene.trajectory import Trajectory

CAMERA = Camera(width=120, height=90, fx_px=110.0, fy_px=110.0, cx_px=59.5, cy_px=44.5)
DURATION_US = 400_000
BASELINE_M = 0.4
# A frame and a bar behind it, camera frame of the middle pose.
SEGMENTS = np.array(
    [
        [[-0.4, -0.3, 1.4], [0.4, -0.3, 1.4]],
        [[0.4, -0.3, 1.4], [0.4, 0.3, 1.4]],
        [[0.4, 0.3, 1.4], [-0.4, 0.3, 1.4]],
        [[-0.4, 0.3, 1.4], [-0.4, -0.3, 1.4]],
        [[-0.3, -0.1, 1.7], [0.35, 0.2, 2.0]],
    ]
)
SETTINGS = EmvsSettings(
    min_depth_m=0.8,
    max_depth_m=4.0,
    plane_count=80,
    # Votes without noise stand out, and lower maxima are chance meetings of rays.
    threshold_window_px=5,
    threshold_offset=25.0,
    median_window_px=5,
    # One span, as long as the slide.
    keyframes=KeyframeSettings(distance_share=1.0, min_baseline_share=0.0),
)


def sliding_trajectory() -> Trajectory:
    """A straight slide along (1, 0.6, 0), 200 Hz."""
    t_us = np.arange(0, DURATION_US + 1, 5000)
    share = t_us / DURATION_US - 0.5
    direction = np.array([1.0, 0.6, 0.0]) / np.hypot(1.0, 0.6)
    translation = BASELINE_M * share[:, None] * direction
    rotation = np.broadcast_to(np.eye(3), (len(t_us), 3, 3))
    return Trajectory(t_us=t_us, T_world_camera=SE3(rotation=rotation, translation=translation))


def exact_events(segments: np.ndarray, trajectory: Trajectory) -> EventStream:
    """An event at the nearest pixel of points along each segment, every 2 ms."""
    share = np.linspace(0.0, 1.0, 60)[:, None]
    points = np.concatenate([(1 - share) * a + share * b for a, b in segments])
    rows = []
    for t_us in range(0, DURATION_US, 2000):
        pose = trajectory.interpolate(np.array([t_us]))[0]
        pixels = np.rint(project(pose.inverse() @ points, CAMERA.matrix)).astype(int)
        inside = (pixels >= 0).all(axis=1) & (pixels < [CAMERA.width, CAMERA.height]).all(axis=1)
        pixels = np.unique(pixels[inside], axis=0)
        rows.append(np.column_stack([np.full(len(pixels), t_us), pixels]))
    t, x, y = np.concatenate(rows).T
    return stream(t, x, y)


def stream(t: np.ndarray, x: np.ndarray, y: np.ndarray) -> EventStream:
    polarity = np.ones(len(t), np.int8)
    size = {"width": CAMERA.width, "height": CAMERA.height}
    return EventStream(t_us=t, x=x, y=y, polarity=polarity, **size)


def distances_to_segments(points: np.ndarray, segments: np.ndarray) -> np.ndarray:
    start, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    share = ((points[:, None] - start) * along).sum(-1) / (along**2).sum(-1)
    nearest = start + np.clip(share, 0.0, 1.0)[..., None] * along
    return np.linalg.norm(points[:, None] - nearest, axis=-1).min(axis=1)


@pytest.fixture(scope="module")
def slide() -> tuple[EventStream, Trajectory]:
    trajectory = sliding_trajectory()
    return exact_events(SEGMENTS, trajectory), trajectory


def test_points_lie_on_the_edges_as_well_as_pixels_and_planes_allow(slide):
    points = map_points(*slide, CAMERA, SETTINGS)
    # Rays are off by half a pixel (rounded events) and votes by one more; over the baseline that is
    # 1.5 Z^2 / (f b) in depth, to which half a step between planes adds.
    deepest_m = SEGMENTS[..., 2].max()
    step = (1 / SETTINGS.min_depth_m - 1 / SETTINGS.max_depth_m) / (SETTINGS.plane_count - 1)
    tolerance_m = deepest_m**2 * (1.5 / (CAMERA.fx_px * BASELINE_M) + step / 2)
    distances_m = distances_to_segments(points, SEGMENTS)
    assert len(points) > 200
    # Lines parallel to an epipolar line would be free in depth; none is here.
    assert np.percentile(distances_m, 95) < tolerance_m
    assert np.median(distances_m) < tolerance_m / 3


def test_all_edges_are_covered(slide):
    points = map_points(*slide, CAMERA, SETTINGS)
    for segment in SEGMENTS:
        share = np.linspace(0.15, 0.85, 15)[:, None]
        along = (1 - share) * segment[0] + share * segment[1]
        gaps_m = np.linalg.norm(along[:, None] - points, axis=-1).min(axis=1)
        assert np.median(gaps_m) < 0.06


def test_moved_world_moves_the_points(slide):
    events, trajectory = slide
    turn = se3.rotation_from_vector(np.array([0.3, -0.5, 0.9]))
    moved = SE3(rotation=turn, translation=np.array([2.0, -1.0, 0.5]))
    there = Trajectory(t_us=trajectory.t_us, T_world_camera=moved @ trajectory.T_world_camera)
    expected = moved @ map_points(events, trajectory, CAMERA, SETTINGS)
    found = map_points(events, there, CAMERA, SETTINGS)
    # Votes are float32, and a vote beside a threshold may fall either way.
    assert abs(len(found) - len(expected)) <= 0.02 * len(expected)
    nearest_m = np.linalg.norm(found[:, None] - expected, axis=-1).min(axis=1)
    assert np.mean(nearest_m < 1e-6) > 0.97


class Chunked:
    """The same events in pieces of any size."""

    def __init__(self, events: EventStream, size: int) -> None:
        self.width, self.height = events.width, events.height
        self.time_range_us = events.time_range_us
        self._pieces = [
            stream(events.t_us[i : i + size], events.x[i : i + size], events.y[i : i + size])
            for i in range(0, len(events), size)
        ]

    def chunks(self):
        return iter(self._pieces)


def test_chunks_do_not_change_the_map(slide):
    events, trajectory = slide
    spans = EmvsSettings(
        min_depth_m=0.8,
        max_depth_m=4.0,
        plane_count=24,
        keyframes=KeyframeSettings(distance_share=0.1),
    )
    whole = map_points(events, trajectory, CAMERA, spans)
    pieces = map_points(Chunked(events, 1237), trajectory, CAMERA, spans)
    np.testing.assert_array_equal(whole, pieces)


def test_recording_without_events_is_refused():
    empty = np.empty(0, np.int64)
    with pytest.raises(EventsError, match="at least one event"):
        map_points(stream(empty, empty, empty), sliding_trajectory(), CAMERA, SETTINGS)


def test_volume_larger_than_the_limit_is_refused(slide):
    large = Camera(width=4000, height=3000, fx_px=2000, fy_px=2000, cx_px=2000, cy_px=1500)
    with pytest.raises(LimitError, match="voxels"):
        map_points(*slide, large, SETTINGS)


@pytest.mark.parametrize(
    "wrong",
    [{"min_depth_m": 0.0}, {"max_depth_m": 0.1}, {"plane_count": 1}, {"median_window_px": 4}],
)
def test_impossible_settings_are_refused(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        EmvsSettings(**wrong)


@settings(max_examples=30, deadline=None)
@given(
    turn=st.lists(st.floats(-0.3, 0.3), min_size=3, max_size=3),
    shift=st.lists(st.floats(-0.3, 0.3), min_size=3, max_size=3),
    pixel=st.tuples(st.floats(0, 119), st.floats(0, 89)),
    depth_m=st.floats(0.5, 5.0),
)
def test_a_ray_passes_through_its_point_on_every_plane(turn, shift, pixel, depth_m):
    T_reference_camera = SE3(
        rotation=se3.rotation_from_vector(np.array([turn])), translation=np.array([shift])
    )
    K = CAMERA.matrix
    homography = emvs.far_plane_homographies(T_reference_camera, K, 5.0)[0]
    far_px = homography @ [*pixel, 1.0]
    transfer = emvs.plane_transfers(T_reference_camera.translation, K, 5.0, np.array([depth_m]))[
        0, 0
    ]
    found_px = transfer[0] * far_px[:2] / far_px[2] + transfer[1:]

    ray = T_reference_camera.rotation[0] @ np.linalg.inv(K) @ [*pixel, 1.0]
    centre = T_reference_camera.translation[0]
    point = centre + (depth_m - centre[2]) / ray[2] * ray
    expected_px = (K @ point)[:2] / point[2]
    np.testing.assert_allclose(found_px, expected_px, rtol=1e-9, atol=1e-7)  # px, float64


def test_planes_behind_a_camera_get_no_votes():
    centre = np.array([[0.0, 0.0, 1.0]])
    transfers = emvs.plane_transfers(centre, CAMERA.matrix, 4.0, np.array([0.5, 2.0]))
    assert np.isnan(transfers[0]).all()
    assert np.isfinite(transfers[1]).all()


def test_median_counts_masked_pixels_alone():
    rng = np.random.default_rng(3)
    values = rng.integers(0, 50, (12, 15))
    mask = rng.random((12, 15)) < 0.4
    found = emvs_kernels.masked_median(values, mask, 2)
    for row, column in np.argwhere(mask):
        window = slice(max(0, row - 2), row + 3), slice(max(0, column - 2), column + 3)
        inside = np.sort(values[window][mask[window]])
        assert found[row, column] == inside[len(inside) // 2]
    np.testing.assert_array_equal(found[~mask], values[~mask])


def test_spans_follow_each_other_and_are_as_long_as_the_depth_asks():
    trajectory = sliding_trajectory()
    keyframes = KeyframeSettings(distance_share=0.1)
    spans, start_us = [], 0
    while (span := span_from(start_us, 1.0, trajectory, CAMERA, keyframes)) is not None:
        spans.append(span)
        start_us = span.stop_us
    assert [span.start_us for span in spans[1:]] == [span.stop_us for span in spans[:-1]]
    assert spans[-1].stop_us == DURATION_US + 1
    step_m = BASELINE_M * 5000 / DURATION_US
    for span in spans[:-1]:
        assert 0.1 < span.baseline_m <= 0.1 + step_m + 1e-9  # m; the first pose beyond
        assert span.is_wide


def test_a_turn_on_the_spot_gives_no_depths():
    t_us = np.arange(0, 1_000_001, 10_000)
    yaw = np.zeros((len(t_us), 3))
    yaw[:, 1] = np.linspace(0.0, 3.0, len(t_us))
    turning = Trajectory(
        t_us=t_us,
        T_world_camera=SE3(
            rotation=se3.rotation_from_vector(yaw), translation=np.zeros((len(t_us), 3))
        ),
    )
    span = span_from(0, 1.0, turning, CAMERA, KeyframeSettings())
    assert not span.is_wide
    half_field_rad = np.arctan(60 / 110)
    assert span.stop_us * 1e-6 * 3.0 == pytest.approx(half_field_rad, abs=0.04)
