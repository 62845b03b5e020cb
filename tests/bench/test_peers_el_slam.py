from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from roel_bench.peers import el_slam
from roel_bench.peers.el_slam import ElSlamSettings, map_segments
from roel_bench.peers.emvs import EmvsSettings, KeyView
from roel_bench.peers.keyframes import KeyframeSettings
from roel_service.errors import EventsError
from roel_service.geometry.projection import project
from roel_service.geometry.se3 import SE3
from roel_service.geometry.vectors import norm
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventStream
from roel_service.scene.trajectory import Trajectory

CAMERA = Camera(width=120, height=90, fx_px=110.0, fy_px=110.0, cx_px=59.5, cy_px=44.5)
DURATION_US = 200_000
BASELINE_M = 0.4
BARS = np.array([[[-0.4, -0.3, 1.4], [0.4, -0.25, 1.4]], [[-0.3, 0.0, 1.7], [0.35, 0.3, 2.0]]])


def recording(segments: np.ndarray) -> tuple[EventStream, Trajectory]:
    """A slide along (1, 1, 0), and an event at each pixel of the segments every 2 ms."""
    t_us = np.arange(0, DURATION_US + 1, 2000)
    share = t_us / DURATION_US - 0.5
    translation = BASELINE_M / np.sqrt(2) * share[:, None] * np.array([1.0, 1.0, 0.0])
    rotation = np.broadcast_to(np.eye(3), (len(t_us), 3, 3))
    trajectory = Trajectory(
        t_us=t_us, T_world_camera=SE3(rotation=rotation, translation=translation)
    )
    along = np.linspace(0.0, 1.0, 80)[:, None]
    points = np.concatenate([(1 - along) * a + along * b for a, b in segments])
    rows = []
    for t, centre in zip(t_us, translation, strict=True):
        pixels = np.unique(np.rint(project(points - centre, CAMERA.matrix)).astype(int), axis=0)
        inside = (pixels >= 0).all(axis=1) & (pixels < [CAMERA.width, CAMERA.height]).all(axis=1)
        rows.append(np.column_stack([np.full(inside.sum(), t), pixels[inside]]))
    t, x, y = np.concatenate(rows).T
    return stream(t, x, y), trajectory


def stream(t: np.ndarray, x: np.ndarray, y: np.ndarray) -> EventStream:
    polarity = np.ones(len(t), np.int8)
    size = {"width": CAMERA.width, "height": CAMERA.height}
    return EventStream(t_us=t, x=x, y=y, polarity=polarity, **size)


SETTINGS = ElSlamSettings(
    emvs=EmvsSettings(
        min_depth_m=0.8,
        max_depth_m=4.0,
        plane_count=80,
        threshold_window_px=5,
        threshold_offset=10.0,
        median_window_px=5,
        keyframes=KeyframeSettings(distance_share=1.0, min_baseline_share=0.0),
    ),
    hough_vote_count=10,
    hough_length_px=8.0,
    inlier_share=0.03,
)


def test_bars_become_segments_as_good_as_pixels_and_planes_allow():
    segments = map_segments(*recording(BARS), CAMERA, SETTINGS)
    # As for EMVS: 1.5 px over the baseline, and half a step between planes.
    step = (1 / 0.8 - 1 / 4.0) / 79
    tolerance_m = BARS[..., 2].max() ** 2 * (1.5 / (CAMERA.fx_px * BASELINE_M) + step / 2)
    assert len(segments) == len(BARS)
    share = np.linspace(0.0, 1.0, 101)[:, None]
    for start, end in BARS:
        length_m = np.linalg.norm(end - start)
        along = (end - start) / length_m
        across_m = norm(segments - start - ((segments - start) @ along)[..., None] * along)
        good = segments[across_m.max(axis=-1) < tolerance_m]
        reach = np.sort((good - start) @ along / length_m, axis=1)
        covered = (reach[:, :1, None] <= share.T) & (reach[:, 1:, None] >= share.T)
        # The votes' border and the Hough transform may cost either end a length of 8 px.
        length_px = np.linalg.norm(np.diff(project(np.stack([start, end]), CAMERA.matrix), axis=0))
        assert covered.any(axis=0).mean() > 1.0 - 2 * 8.0 / length_px


def test_recording_without_events_is_refused():
    _, trajectory = recording(BARS)
    empty = np.empty(0, np.int64)
    with pytest.raises(EventsError, match="at least one event"):
        map_segments(stream(empty, empty, empty), trajectory, CAMERA, SETTINGS)


def test_view_without_lines_gives_none():
    mask = np.zeros((90, 120), np.bool_)
    mask[20::10, 20::10] = True
    view = KeyView(
        T_world_camera=SE3.identity(),
        K=CAMERA.matrix,
        votes=np.zeros((90, 120), np.float32),
        depth_m=np.full((90, 120), 2.0),
        mask=mask,
    )
    assert el_slam.view_segments(view, SETTINGS, np.random.default_rng(0)) == []


@pytest.mark.parametrize(
    ("other", "merges"),
    [
        ([[52.0, 20.0], [90.0, 21.0]], True),  # 2 px farther on
        ([[56.0, 20.0], [90.0, 21.0]], False),  # 6 px, beyond 5 px m at 1 m
        ([[52.0, 45.0], [90.0, 45.0]], False),  # 25 px farther from the origin
        ([[52.0, 20.0], [72.0, 28.0]], False),  # 22 degrees
        ([[90.0, 21.0], [52.0, 20.0]], True),  # the other way round
    ],
)
def test_segments_merge_by_distance_angle_and_gap(other, merges):
    segments = np.array([[[10.0, 20.0], [50.0, 20.0]], other])
    groups = el_slam.merged_groups(segments, 1.0, SETTINGS)
    assert (len(groups) == 1) == merges


def test_farther_scenes_merge_over_smaller_gaps():
    segments = np.array([[[10.0, 20.0], [50.0, 20.0]], [[53.0, 20.0], [90.0, 20.0]]])
    assert len(el_slam.merged_groups(segments, 1.0, SETTINGS)) == 1
    assert len(el_slam.merged_groups(segments, 2.0, SETTINGS)) == 2


def test_pixels_beside_a_segment_and_between_its_ends_are_its_points():
    pixels = np.array([[5.0, 1.0], [5.0, 2.0], [-1.0, 0.0], [11.0, 0.0], [10.0, 0.0]])
    segments = np.array([[[0.0, 0.0], [10.0, 0.0]]])
    found = el_slam.near_segments(pixels, segments, 1.5)
    assert found.tolist() == [True, False, False, False, True]


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000))
def test_fit_ignores_a_third_of_outliers(seed):
    rng = np.random.default_rng(seed)
    ends = rng.uniform([-1, -1, 2], [1, 1, 4], (2, 3)) + np.array([[0, 0, 0], [0.5, 0, 0]])
    share = np.linspace(0.0, 1.0, 40)[:, None]
    outliers = rng.uniform([-1, -1, 2], [1, 1, 4], (20, 3))
    points = np.concatenate([(1 - share) * ends[0] + share * ends[1], outliers])
    # Exact points, so that only outliers within 2 um of the line could move it.
    exact = replace(SETTINGS, inlier_share=1e-6)
    segment = el_slam.fitted_segment(points, exact, rng)
    assert segment is not None
    gaps_m = np.linalg.norm(segment[:, None] - ends, axis=-1).min(axis=1)
    assert gaps_m.max() < 1e-5


def test_scattered_few_or_equal_points_are_no_line():
    rng = np.random.default_rng(0)
    points = rng.uniform([-1, -1, 2], [1, 1, 4], (60, 3))
    assert el_slam.fitted_segment(points, SETTINGS, rng) is None
    assert el_slam.fitted_segment(points[:5], SETTINGS, rng) is None
    assert el_slam.fitted_segment(np.repeat(points[:1], 30, axis=0), SETTINGS, rng) is None
