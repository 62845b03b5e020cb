import dataclasses

import numpy as np
import pytest

from roel_service.config.stages import MatchLocalConfig
from roel_service.geometry import projection, segments
from roel_service.mapping.match_local import match_adjacent_frames, predict
from roel_service.mapping.match_local_kernels import facing_share

from .synthetic import observed, still_frames, world

DEFAULT = MatchLocalConfig()
FAR = MatchLocalConfig(reach_frame_count=3)
PAPER = MatchLocalConfig(predict=False, max_distance_px=10.0, min_overlap=0.0)


def tracks_of(rows, config=DEFAULT, frames=None):
    """Tracks as lists of rows."""
    observations = observed(*rows)
    frame_count = 1 + max((row[0] for row in rows), default=0)
    tracks = match_adjacent_frames(observations, frames or still_frames(frame_count), config)
    return [tracks[index].tolist() for index in range(len(tracks))]


LINE = np.array([[40.0, 30.0], [110.0, 70.0]])
OTHER = np.array([[20.0, 100.0], [90.0, 100.0]])
UP = np.array([0.0, -1.0])


class TestExactObservations:
    @pytest.mark.parametrize("scale", [1.0, 100.0])
    def test_tracks_are_the_true_lines(self, scale):
        exact = world(scale)
        tracks = match_adjacent_frames(exact.observations, exact.frames, DEFAULT)
        assert len(tracks) == len(exact.segments)
        for line in range(len(tracks)):
            assert set(exact.line_of[tracks[line]]) == {exact.line_of[tracks[line][0]]}
        np.testing.assert_array_equal(np.sort(tracks.sizes), np.sort(np.bincount(exact.line_of)))

    def test_every_observation_is_in_exactly_one_track(self):
        noisy = world(noise_px=0.5)
        tracks = match_adjacent_frames(noisy.observations, noisy.frames, DEFAULT)
        np.testing.assert_array_equal(
            np.sort(tracks.observation), np.arange(len(noisy.observations))
        )

    def test_no_track_has_two_lines_of_one_frame(self):
        noisy = world(noise_px=2.0)
        tracks = match_adjacent_frames(noisy.observations, noisy.frames, PAPER)
        for line in range(len(tracks)):
            frames = noisy.observations.frame[tracks[line]]
            assert (np.diff(frames) > 0).all()

    def test_the_error_of_prediction_falls_with_the_square_of_the_time(self):
        errors_px = []
        for frame_count in (24, 231):  # 85 and 8.5 ms apart
            exact = world(frame_count=frame_count)
            frame = frame_count // 2
            here = np.flatnonzero(exact.observations.frame == frame)
            there = np.flatnonzero(exact.observations.frame == frame + 1)
            moved = predict(here, np.array([frame + 1]), exact.observations, exact.frames)
            offset = segments.point_line_offset(
                segments.midpoint(moved), exact.observations.segments_px[there]
            )
            errors_px.append(np.abs(offset))
        # A tenth of the time leaves a hundredth of the error, but for higher orders.
        assert (errors_px[1] < errors_px[0] / 50 + 0.01).all()
        assert errors_px[0].max() > 0.1


class TestGates:
    def test_a_line_that_stays_is_one_track(self):
        assert tracks_of([(0, LINE), (1, LINE), (2, LINE)]) == [[0, 1, 2]]

    def test_a_line_that_is_too_far_starts_a_track(self):
        near, far = LINE + 2.0 * UP, LINE + 4.0 * UP
        assert tracks_of([(0, LINE), (1, near)]) == [[0, 1]]
        assert tracks_of([(0, LINE), (1, far)]) == [[0], [1]]
        wider = dataclasses.replace(DEFAULT, max_distance_px=5.0)
        assert tracks_of([(0, LINE), (1, far)], wider) == [[0, 1]]

    def test_opposite_polarities_do_not_match_but_unknown_ones_do(self):
        assert tracks_of([(0, LINE, 1), (1, LINE, -1)]) == [[0], [1]]
        assert tracks_of([(0, LINE, 1), (1, LINE, 0)]) == [[0, 1]]
        assert tracks_of([(0, LINE, 0), (1, LINE, -1)]) == [[0, 1]]

    def test_collinear_lines_apart_do_not_match(self):
        step = LINE[1] - LINE[0]
        first, second = LINE[0] + np.array([[0], [0.4]]) * step, LINE[0] + [[0.5], [1.0]] * step
        for config in (DEFAULT, PAPER):
            assert tracks_of([(0, first), (1, second)], config) == [[0], [1]]

    def test_lines_must_face_each_other_over_a_share_of_the_shorter_one(self):
        step = LINE[1] - LINE[0]
        # They share 0.1 of the length 0.5 of both: one fifth.
        first, second = LINE[0] + np.array([[0], [0.5]]) * step, LINE[0] + [[0.4], [0.9]] * step
        assert tracks_of([(0, first), (1, second)]) == [[0], [1]]
        less = dataclasses.replace(DEFAULT, min_overlap=0.1)
        assert tracks_of([(0, first), (1, second)], less) == [[0, 1]]

    def test_a_short_piece_of_a_long_line_faces_it_wholly(self):
        piece = LINE[0] + np.array([[0.4], [0.5]]) * (LINE[1] - LINE[0])
        assert facing_share(piece, LINE) == pytest.approx(1.0)
        assert facing_share(LINE, piece) == pytest.approx(1.0)

    def test_the_nearer_of_two_lines_continues_the_track(self):
        rows = [(0, LINE), (1, LINE + 1.5 * UP), (1, LINE - 0.5 * UP)]
        assert tracks_of(rows) == [[0, 2], [1]]

    def test_only_mutual_neighbours_match(self):
        # Row 1 is nearest to row 2, which has a nearer partner in row 0.
        rows = [(0, LINE), (0, LINE + 1.5 * UP), (1, LINE + 0.4 * UP)]
        assert tracks_of(rows) == [[0, 2], [1]]

    def test_direction_of_a_segment_does_not_matter(self):
        assert tracks_of([(0, LINE), (1, LINE[::-1])]) == [[0, 1]]


class TestReach:
    def test_a_track_reaches_back_over_missing_frames(self):
        assert tracks_of([(0, LINE), (3, LINE)], FAR) == [[0, 1]]
        assert tracks_of([(0, LINE), (4, LINE)], FAR) == [[0], [1]]

    def test_with_a_reach_of_one_frame_a_gap_ends_the_track(self):
        assert tracks_of([(0, LINE), (1, LINE), (3, LINE)]) == [[0, 1], [2]]

    def test_a_continued_track_has_one_open_end(self):
        # The line jumps; what comes back must not join the end that was continued already.
        rows = [(0, LINE), (1, LINE + 2 * UP), (2, LINE + 4 * UP), (2, LINE)]
        assert tracks_of(rows, FAR) == [[0, 1, 2], [3]]


class TestPrediction:
    def test_a_line_is_met_where_its_speed_takes_it(self):
        # 0.8 px/ms over 10 ms are 8 px along the left normal.
        moved = LINE + 8.0 * segments.left_normal(LINE)
        rows = [(0, LINE, 1, 0.8), (1, moved, 1, 0.8)]
        assert tracks_of(rows) == [[0, 1]]
        assert tracks_of(rows, dataclasses.replace(DEFAULT, predict=False)) == [[0], [1]]

    def test_speed_follows_the_direction_of_the_segment(self):
        moved = LINE + 8.0 * segments.left_normal(LINE)
        rows = [(0, LINE[::-1], 1, -0.8), (1, moved, 1, 0.8)]
        assert tracks_of(rows) == [[0, 1]]

    def test_a_fast_turn_of_the_camera_is_undone(self):
        # Far lines: 0.15 rad a frame move them by some 20 px.
        frames = still_frames(4, turn_rad=0.15)
        far = np.array([[-10.0, -20.0, 100.0], [10.0, 25.0, 100.0]])
        rows = [
            (index, projection.project(frames.T_world_camera[index].inverse() @ far, frames.K))
            for index in range(4)
        ]
        assert np.abs(rows[1][1] - rows[0][1]).max() > 15
        assert tracks_of(rows, frames=frames) == [[0, 1, 2, 3]]
        assert len(tracks_of(rows, dataclasses.replace(DEFAULT, predict=False), frames)) == 4
        predicted = predict(np.array([0]), np.array([3]), observed(*rows), frames)[0]
        np.testing.assert_allclose(predicted, rows[3][1], rtol=0, atol=1e-10)  # px, float64


class TestDegenerate:
    @pytest.mark.parametrize("config", [DEFAULT, PAPER])
    @pytest.mark.parametrize("frame_count", [1, 5])
    def test_without_lines_there_are_no_tracks(self, config, frame_count):
        tracks = match_adjacent_frames(observed(), still_frames(frame_count), config)
        assert len(tracks) == 0

    def test_no_frames_give_no_tracks(self):
        assert len(match_adjacent_frames(observed(), still_frames(0), DEFAULT)) == 0

    def test_every_lonely_line_is_a_track(self):
        assert tracks_of([(0, LINE), (0, OTHER), (2, OTHER + 30)]) == [[0], [1], [2]]
