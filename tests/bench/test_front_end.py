import numpy as np
import pytest

from roel_bench.front_end import (
    FrameScores,
    FrameTruth,
    explained_share,
    lines_of_frames,
    run_front_end,
    still_trajectory,
)
from roel_service.config.load import with_tables
from roel_service.config.presets import preset
from roel_service.errors import NoAnswerError
from roel_service.scene.events import EventStream
from tests.bench.samples import CAMERA, HEIGHT, WIDTH, moving_camera, random_events, scene, truth
from tests.bench.samples import square as square_at

CONFIG = with_tables(
    preset("default"), {"frames": {"max_half_window_us": 10_000}}, subject="sample"
)
DEPTH_M = 2.0
# The camera moves along x at 1 m/s: 30 px/s at that depth.
SPEED_PX_PER_MS = -0.03
COLUMN_PX = 40.0


def moving_edge(duration_us=300_000, events_a_row=60, seed=0):
    """Events of an upright edge at x = COLUMN_PX at t = 0, and one by one as it passes."""
    rng = np.random.default_rng(seed)
    t_us = np.sort(rng.integers(0, duration_us, events_a_row * HEIGHT))
    x = np.rint(COLUMN_PX + SPEED_PX_PER_MS * t_us * 1e-3 + rng.normal(0, 0.2, len(t_us)))
    return EventStream(
        t_us=t_us,
        x=x.astype(int),
        y=rng.integers(0, HEIGHT, len(t_us)),
        polarity=np.ones(len(t_us), int),
        width=WIDTH,
        height=HEIGHT,
    )


def edge_scene():
    """The right side of a square is the edge; its points are the truth."""
    side_m = 2 * (COLUMN_PX - CAMERA.cx_px) / CAMERA.fx_px * DEPTH_M
    y = np.arange(-side_m / 2, side_m / 2, 0.01)
    points = np.stack([np.full(len(y), side_m / 2), y, np.full(len(y), DEPTH_M)], axis=1)
    known = truth(square_at(side_m, DEPTH_M), points)
    return scene(events=moving_edge(), trajectory=moving_camera(duration_us=300_000), truth=known)


@pytest.fixture(scope="module")
def found():
    return list(lines_of_frames(edge_scene(), CONFIG, stride=4))


def test_every_so_many_frames_are_looked_at(found):
    times = [frame.frame.events.t_ref_us for frame in found]
    # 24 frames at least between 10 and 290 ms.
    assert len(times) == 6
    assert np.diff(times) == pytest.approx(4 * 280_000 / 24, rel=0.01)


def test_the_edge_is_found_where_it_is(found):
    for frame in found:
        t_ms = frame.frame.events.t_ref_us * 1e-3
        columns = frame.lines.segments_px[..., 0]
        # Events are rounded to pixels; their mean is not.
        assert columns == pytest.approx(COLUMN_PX + SPEED_PX_PER_MS * t_ms, abs=0.7)


def test_events_on_a_moving_line_are_explained(found):
    assert all(explained_share(frame) > 0.9 for frame in found)


def test_figures_against_the_truth():
    sample = edge_scene()
    frame_truth = FrameTruth(sample, sample.truth, sample.trajectory)
    scores = run_front_end(sample, CONFIG, frame_truth, lambda done, total: None, 4)
    figures = scores.figures()
    assert scores.frame_count == 6
    # The square is shorter than the picture is high, events are not.
    assert figures["recall"] > 0.8
    assert 0.2 < figures["precision"] < 1.0
    assert figures["ms_per_frame"] > 0
    assert set(scores.seconds) == {"detect", "plane_fit"}


def test_recording_without_poses_has_lines_but_no_comparison():
    sample = scene(events=moving_edge(), trajectory=None)
    figures = run_front_end(sample, CONFIG, None, lambda done, total: None, 8).figures()
    assert figures["lines_per_frame"] >= 1
    assert figures["explained_event_share"] > 0.9
    assert "f_score" not in figures


def test_still_camera_covers_all_events():
    events = random_events(duration_us=3_000_000)
    trajectory = still_trajectory(events)
    assert trajectory.covers(events.t_us).all()
    assert np.allclose(trajectory.T_world_camera.translation, 0.0)


def test_too_short_a_recording_is_refused():
    sample = scene(events=random_events(duration_us=100), trajectory=None)
    with pytest.raises(NoAnswerError, match="at least one frame"):
        list(lines_of_frames(sample, CONFIG, 1))


def test_no_frames_no_figures():
    assert FrameScores().figures()["explained_event_share"] is None
