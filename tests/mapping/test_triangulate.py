import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from roel_service.config.stages import TriangulateConfig
from roel_service.geometry import plucker, segments
from roel_service.geometry.se3 import SE3, rotation_from_vector
from roel_service.mapping import triangulate
from roel_service.mapping.triangulate import triangulate_tracks
from roel_service.mapping.views import views_of
from roel_service.scene.lines import LineTracks
from roel_service.scene.results import TrackStatus

from .synthetic import frames_of, line_errors, observed, world

PIXEL = TriangulateConfig(gate="pixel")
GRASSMANN = TriangulateConfig(gate="grassmann")
GATES = pytest.mark.parametrize("config", [PIXEL, GRASSMANN], ids=["pixel", "grassmann"])


def triangulated(world, tracks=None, config=PIXEL, seed=0, observations=None, frames=None):
    frames = frames or world.frames
    views = views_of(world.observations if observations is None else observations, frames)
    rng = np.random.default_rng(seed)
    tracks = world.tracks if tracks is None else tracks
    return triangulate_tracks(tracks, views, frames, config, rng)


def changed(observations, segments_px):
    return dataclasses.replace(observations, segments_px=segments_px)


class TestExact:
    @GATES
    @pytest.mark.parametrize("scale", [1.0, 100.0])
    def test_lines_are_recovered(self, config, scale):
        exact = world(scale)
        found = triangulated(exact, config=config)
        assert found.statuses == [TrackStatus.TRIANGULATED] * len(exact.segments)
        # 1e-9 m in a scene of 1 m; rounding grows with the scene.
        assert line_errors(found.lines, exact.segments).max() < 1e-9 * scale

    @GATES
    def test_all_observations_support_their_line(self, config):
        exact = world()
        found = triangulated(exact, config=config)
        np.testing.assert_array_equal(found.tracks.offsets, exact.tracks.offsets)
        np.testing.assert_array_equal(found.tracks.observation, exact.tracks.observation)

    def test_long_tracks_are_scored_on_a_sample_but_gathered_whole(self):
        exact = world(frame_count=90)
        found = triangulated(
            exact, config=dataclasses.replace(PIXEL, scored_observation_count=5, pair_count=10)
        )
        assert line_errors(found.lines, exact.segments).max() < 1e-9
        np.testing.assert_array_equal(found.tracks.sizes, exact.tracks.sizes)

    def test_lines_follow_the_order_of_the_tracks_whatever_their_lengths(self):
        exact = world()
        tracks = LineTracks.from_lists(
            [exact.tracks[line][: 4 + 20 * (line % 2)] for line in range(len(exact.tracks))]
        )
        config = dataclasses.replace(PIXEL, min_plane_angle_deg=0.01)
        found = triangulated(exact, tracks, config)
        assert line_errors(found.lines, exact.segments).max() < 1e-8

    @pytest.mark.parametrize(
        "config", [dataclasses.replace(gate, pair_count=10) for gate in (PIXEL, GRASSMANN)]
    )
    @settings(max_examples=10, deadline=None)
    @given(
        st.tuples(*[st.floats(-2.0, 2.0)] * 3),
        st.tuples(*[st.floats(-5.0, 5.0)] * 3),
    )
    def test_moving_the_world_moves_the_lines_alike(self, config, turn, shift):
        here = world(frame_count=8)
        T_b_a = SE3(rotation=rotation_from_vector(np.array(turn)), translation=np.array(shift))
        moved = dataclasses.replace(here.frames, T_world_camera=T_b_a @ here.frames.T_world_camera)
        expected = triangulated(here, config=config)
        found = triangulated(here, config=config, frames=moved)
        assert len(expected.lines) > 6
        assert found.statuses == expected.statuses
        good = [status is TrackStatus.TRIANGULATED for status in found.statuses]
        assert line_errors(found.lines, T_b_a @ here.segments[good]).max() < 1e-9


class TestNoise:
    @GATES
    def test_errors_stay_in_proportion_to_the_noise(self, config):
        noisy = world(noise_px=0.1)
        found = triangulated(noisy, config=dataclasses.replace(config, min_inlier_count=3))
        assert found.statuses == [TrackStatus.TRIANGULATED] * len(noisy.segments)
        # One pair decides, with planes at least 0.4 degrees apart; the best of 60 has a wide angle:
        # 0.1 px at 120 px and 2.5 m, 10 degrees apart, is 12 mm, and an end is looked at from
        # half a length away.
        assert np.median(line_errors(found.lines, noisy.segments)[:, 0]) < 0.024

    def test_outliers_are_left_out(self):
        exact = world()
        lines = exact.observations.segments_px.copy()
        rng = np.random.default_rng(1)
        wrong = rng.random(len(lines)) < 0.3
        # Away by 6 px or more: beyond the gate of 2.5 px, and turned.
        shift = rng.choice([-1, 1], (wrong.sum(), 1, 1)) * rng.uniform(6, 20, (wrong.sum(), 2, 1))
        lines[wrong] += shift * segments.left_normal(lines[wrong])[:, None]
        found = triangulated(exact, observations=changed(exact.observations, lines))
        assert line_errors(found.lines, exact.segments).max() < 1e-9
        assert not wrong[found.tracks.observation].any()
        # A wrong one may lie along the line's own epipolar plane by chance, a right one is kept.
        assert len(found.tracks.observation) == (~wrong).sum()

    @pytest.mark.parametrize(
        ("name", "shift_px", "turn_px"),
        [("max_perpendicular_px", 3.0, 0.0), ("max_angle_2d_deg", 0.0, 3.0)],
    )
    def test_grassmann_gate_judges_the_image_too(self, name, shift_px, turn_px):
        exact = world(lines=(2,))
        lines = exact.observations.segments_px.copy()
        offset = np.array([[shift_px - turn_px], [shift_px + turn_px]])
        lines[5] += offset * segments.left_normal(lines[5])
        open_gates = dict.fromkeys(
            (
                "max_angle_3d_deg",
                "max_angle_2d_deg",
                "max_grassmann_angle_deg",
                "max_perspective",
                "max_perpendicular_px",
            ),
            90.0,
        )
        observations = changed(exact.observations, lines)
        loose = TriangulateConfig(gate="grassmann", **open_gates)
        assert 5 in triangulated(exact, config=loose, observations=observations).tracks[0]
        strict = TriangulateConfig(gate="grassmann", **(open_gates | {name: 2.0}))
        found = triangulated(exact, config=strict, observations=observations)
        assert found.tracks[0].tolist() == [k for k in range(24) if k != 5]

    @pytest.mark.parametrize(
        ("name", "strict"),
        [("max_grassmann_angle_deg", 0.02), ("max_angle_3d_deg", 0.02), ("max_perspective", 1e-4)],
    )
    def test_each_distance_in_space_can_bind(self, name, strict):
        noisy = world(noise_px=0.3)
        free = dataclasses.replace(
            GRASSMANN,
            max_grassmann_angle_deg=90.0,
            max_angle_3d_deg=90.0,
            max_perspective=1e3,
            min_inlier_count=2,
        )
        wide = triangulated(noisy, config=free)
        tight = triangulated(noisy, config=dataclasses.replace(free, **{name: strict}))
        assert len(tight.tracks.observation) < 0.5 * len(wide.tracks.observation)


class TestStatus:
    def track_of(self, exact, line, count):
        return LineTracks.from_lists([exact.tracks[line][:count]])

    @GATES
    def test_short_tracks_have_too_few_views(self, config):
        exact = world()
        found = triangulated(exact, self.track_of(exact, 0, 2), config)
        assert found.statuses == [TrackStatus.TOO_FEW_VIEWS]
        assert len(found.lines) == len(found.tracks) == 0

    def test_the_least_number_of_views_is_configured(self):
        exact = world()
        config = dataclasses.replace(PIXEL, min_observation_count=2, min_inlier_count=2)
        ends = LineTracks.from_lists([exact.tracks[0][[0, 12]]])
        assert triangulated(exact, ends, config).statuses == [TrackStatus.TRIANGULATED]

    @GATES
    def test_views_from_one_place_have_low_parallax(self, config):
        exact = world()
        frames = frames_of(exact.frames.T_world_camera[np.zeros(24, int)])
        first = exact.tracks[0][0]
        observations = changed(
            exact.observations,
            np.repeat(exact.observations.segments_px[[first]], len(exact.line_of), axis=0),
        )
        tracks = LineTracks.from_lists([exact.tracks[0]])
        found = triangulated(exact, tracks, config, observations=observations, frames=frames)
        assert found.statuses == [TrackStatus.LOW_PARALLAX]

    def test_the_least_angle_between_planes_is_configured(self):
        exact = world()
        config = dataclasses.replace(PIXEL, min_plane_angle_deg=80.0)
        found = triangulated(exact, config=config)
        assert found.statuses == [TrackStatus.LOW_PARALLAX] * len(exact.segments)

    @pytest.mark.parametrize(
        ("column_px", "status"),
        [(70.0, TrackStatus.TRIANGULATED), (90.0, TrackStatus.LOW_PARALLAX)],
    )
    def test_planes_that_meet_behind_the_cameras_have_no_parallax(self, column_px, status):
        # From a place farther right, what is in front of the camera moves to the left.
        places = np.array([[0.0, 0, 0], [0.2, 0, 0]])
        frames = frames_of(SE3(rotation=np.tile(np.eye(3), (2, 1, 1)), translation=places))
        observations = observed(
            (0, [[80.0, 30.0], [80.0, 90.0]]), (1, [[column_px, 30.0], [column_px, 90.0]])
        )
        config = dataclasses.replace(PIXEL, min_observation_count=2, min_inlier_count=2)
        tracks = LineTracks.from_lists([np.array([0, 1])])
        found = triangulated(None, tracks, config, observations=observations, frames=frames)
        assert found.statuses == [status]

    @GATES
    def test_views_that_disagree_give_too_few_inliers(self, config):
        exact = world()
        # One observation of each of twelve lines.
        tracks = LineTracks.from_lists([np.array([exact.tracks[k][2 * k] for k in range(12)])])
        config = dataclasses.replace(config, min_inlier_count=6)
        found = triangulated(exact, tracks, config)
        assert found.statuses == [TrackStatus.TOO_FEW_INLIERS]
        assert len(found.lines) == 0

    def test_every_track_has_its_status_and_only_good_ones_a_line(self):
        exact = world()
        tracks = LineTracks.from_lists(
            [exact.tracks[0], exact.tracks[1][:1], np.empty(0, np.int32), exact.tracks[3]]
        )
        found = triangulated(exact, tracks)
        assert found.statuses == [
            TrackStatus.TRIANGULATED,
            TrackStatus.TOO_FEW_VIEWS,
            TrackStatus.TOO_FEW_VIEWS,
            TrackStatus.TRIANGULATED,
        ]
        assert line_errors(found.lines, exact.segments[[0, 3]]).max() < 1e-9

    @GATES
    def test_no_tracks_give_no_lines(self, config):
        found = triangulated(world(), LineTracks.from_lists([]), config)
        assert (found.statuses, len(found.lines), len(found.tracks)) == ([], 0, 0)

    @GATES
    def test_no_observations_give_no_lines(self, config):
        found = triangulated(world(), LineTracks.from_lists([]), config, observations=observed())
        assert found.statuses == []


@GATES
def test_equal_seeds_give_equal_lines(config):
    noisy = world(noise_px=0.3)
    first, second = (triangulated(noisy, config=config, seed=7) for _ in range(2))
    np.testing.assert_array_equal(first.lines.moment, second.lines.moment)
    np.testing.assert_array_equal(first.tracks.observation, second.tracks.observation)


def test_large_batches_are_cut_without_changing_what_is_found(monkeypatch):
    exact = world()
    whole = triangulated(exact)
    monkeypatch.setattr("roel_service.mapping.triangulate.BATCH_SIZE", 3 * 24 * PIXEL.pair_count)
    parts = triangulated(exact)
    assert parts.statuses == whole.statuses
    direction, moment = plucker.plucker_from_endpoints(exact.segments)
    sign = np.sign(np.vecdot(direction, parts.lines.direction))[:, None]
    np.testing.assert_allclose(sign * parts.lines.moment, moment, rtol=0, atol=1e-9)


@GATES
def test_lines_are_the_same_with_any_number_of_threads(config, monkeypatch):
    exact = world()
    views = views_of(exact.observations, exact.frames)
    # Several batches, whose pairs are drawn from one generator.
    monkeypatch.setattr(triangulate, "BATCH_SIZE", 2 * config.pair_count)
    alone, together = (
        triangulate_tracks(
            exact.tracks,
            views,
            exact.frames,
            config,
            np.random.default_rng(3),
            worker_count=count,
        )
        for count in (1, 3)
    )
    np.testing.assert_array_equal(alone.lines.moment, together.lines.moment)
    np.testing.assert_array_equal(alone.tracks.observation, together.tracks.observation)
