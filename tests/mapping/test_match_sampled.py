import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from roel_service.config.stages import Config, MatchGlobalConfig
from roel_service.errors import Cancelled
from roel_service.geometry.se3 import SE3
from roel_service.mapping.match_sampled import (
    GeometricMatcher,
    join_tracks,
    match_sampled_frames,
    sampled_pairs,
)
from roel_service.mapping.views import views_of
from roel_service.scene.lines import LineTracks

from .synthetic import frames_of, observed, still_frames, world

CONFIG = Config(
    match_global=MatchGlobalConfig(method="sampled", frame_stride=5, max_distances_px=(5.0,))
)
LINE = np.array([[40.0, 30.0], [110.0, 70.0]])


def unwatched(done_count, total_count):
    """Progress that nobody looks at."""


class Oracle:
    """A matcher that knows which segment is behind each observation."""

    def __init__(self, exact, wrong=0):
        self.frame = exact.observations.frame
        self.line_of = (exact.line_of + wrong) % 12
        self.truth = exact.line_of
        self.asked = []

    def match(self, frame_i, frame_j):
        self.asked.append((frame_i, frame_j))
        pairs = [
            (a, b)
            for a in np.flatnonzero(self.frame == frame_i)
            for b in np.flatnonzero(self.frame == frame_j)
            if self.line_of[a] == self.truth[b]
        ]
        return np.array(pairs, np.int64).reshape(-1, 2)


def broken(exact):
    """Every track in three pieces."""
    return LineTracks.from_lists(
        [part for j in range(12) for part in np.split(exact.tracks[j], [8, 16])]
    )


def joined_by(matcher, exact, tracks, config=CONFIG, progress=unwatched):
    return match_sampled_frames(tracks, exact.views, exact.frames, config, matcher, progress)


def as_sets(tracks):
    return {frozenset(tracks[j].tolist()) for j in range(len(tracks))}


class TestSampledFrames:
    def test_correspondences_make_broken_tracks_whole(self):
        exact = world()
        tracks = joined_by(Oracle(exact), exact, broken(exact))
        assert as_sets(tracks) == as_sets(exact.tracks)

    def test_the_geometric_matcher_does_as_well_on_exact_lines(self):
        exact = world()
        pieces = broken(exact)
        matcher = GeometricMatcher(pieces, exact.views, exact.frames, CONFIG)
        assert as_sets(joined_by(matcher, exact, pieces)) == as_sets(exact.tracks)

    def test_geometric_correspondences_are_true(self):
        noisy = world(noise_px=0.2)
        matcher = GeometricMatcher(noisy.tracks, noisy.views, noisy.frames, CONFIG)
        found = matcher.match(2, 17)
        np.testing.assert_array_equal(noisy.observations.frame[found], [[2, 17]] * len(found))
        np.testing.assert_array_equal(noisy.line_of[found[:, 0]], noisy.line_of[found[:, 1]])
        assert len(found) >= 10

    def test_geometric_correspondences_lie_within_their_distance(self):
        noisy = world(noise_px=0.5)
        settings = dataclasses.replace(CONFIG.match_global, max_distances_px=(0.3,))
        strict = dataclasses.replace(CONFIG, match_global=settings)
        counts = [
            len(GeometricMatcher(noisy.tracks, noisy.views, noisy.frames, config).match(2, 17))
            for config in (CONFIG, strict)
        ]
        assert counts[1] < counts[0]

    def test_tracks_that_cannot_be_triangulated_have_no_correspondences(self):
        exact = world()
        single = LineTracks.from_lists([exact.tracks[j][:1] for j in range(12)])
        matcher = GeometricMatcher(single, exact.views, exact.frames, CONFIG)
        assert matcher.match(0, 5).shape == (0, 2)

    def test_correspondences_against_the_epipolar_geometry_are_dropped(self):
        exact = world()
        wrong = Oracle(exact, wrong=1)
        pieces = broken(exact)
        strict = dataclasses.replace(CONFIG.match_global, min_epipolar_score=0.9)
        tracks = joined_by(wrong, exact, pieces, dataclasses.replace(CONFIG, match_global=strict))
        assert as_sets(tracks) == as_sets(pieces)
        # True ones agree to the last digit.
        tracks = joined_by(
            Oracle(exact), exact, pieces, dataclasses.replace(CONFIG, match_global=strict)
        )
        assert as_sets(tracks) == as_sets(exact.tracks)

    def test_progress_is_told_for_each_pair_and_may_cancel(self):
        exact = world()
        told, oracle = [], Oracle(exact)
        joined_by(oracle, exact, broken(exact), progress=lambda *counts: told.append(counts))
        assert oracle.asked == sampled_pairs(exact.frames, CONFIG.match_global)
        assert told == [(index, len(oracle.asked)) for index in range(len(oracle.asked))]

        def cancel(done_count, total_count):
            raise Cancelled

        with pytest.raises(Cancelled):
            joined_by(oracle, exact, broken(exact), progress=cancel)

    def test_without_tracks_there_is_nothing_to_join(self):
        exact = world()
        views = views_of(observed(), exact.frames)
        nothing = LineTracks.from_lists([])
        matcher = GeometricMatcher(nothing, views, exact.frames, CONFIG)
        joined = match_sampled_frames(nothing, views, exact.frames, CONFIG, matcher, unwatched)
        assert len(joined) == 0


class TestSampledPairs:
    def row(self, count):
        """Cameras 1 m apart on a line."""
        places = np.arange(count)[:, None] * np.array([1.0, 0.0, 0.0])
        return frames_of(SE3(rotation=np.tile(np.eye(3), (count, 1, 1)), translation=places))

    def test_every_nth_frame_meets_its_nearest_ones(self):
        config = MatchGlobalConfig(frame_stride=5, neighbor_count=1)
        # 0, 5, 10: the ends have the middle as neighbour, and the middle has one of them.
        assert set(sampled_pairs(self.row(13), config)) == {(0, 5), (5, 10)}

    def test_more_neighbours_than_frames_make_all_pairs(self):
        config = MatchGlobalConfig(frame_stride=2, neighbor_count=20)
        assert sampled_pairs(self.row(5), config) == [(0, 2), (0, 4), (2, 4)]

    @pytest.mark.parametrize("count", [0, 1, 5])
    def test_one_sampled_frame_makes_no_pair(self, count):
        assert sampled_pairs(self.row(count), MatchGlobalConfig(frame_stride=5)) == []

    def test_cameras_in_one_place_are_all_neighbours(self):
        config = MatchGlobalConfig(frame_stride=1, neighbor_count=3)
        assert sampled_pairs(still_frames(3), config) == [(0, 1), (0, 2), (1, 2)]


def tracks_over(*frames_of_tracks):
    """Tracks of observations in these frames, with their views."""
    placed = sorted(
        (frame, track) for track, frames in enumerate(frames_of_tracks) for frame in frames
    )
    rows = [(frame, LINE) for frame, _ in placed]
    tracks = LineTracks.from_lists(
        [
            np.array([k for k, (_, owner) in enumerate(placed) if owner == track], np.int32)
            for track in range(len(frames_of_tracks))
        ]
    )
    frame_count = 1 + max(frame for frame, _ in placed)
    return tracks, views_of(observed(*rows), still_frames(frame_count))


class TestJoinTracks:
    def test_chains_of_correspondences_join_all(self):
        tracks, views = tracks_over([0], [1], [2], [3])
        joined = join_tracks(tracks, views, np.array([[0, 1], [2, 3], [1, 2]]))
        assert as_sets(joined) == {frozenset({0, 1, 2, 3})}

    def test_tracks_that_meet_in_a_frame_stay_apart(self):
        tracks, views = tracks_over([0, 1], [1, 2], [5])
        # Observations: 0 and 1 of the first track, 2 and 3 of the second.
        joined = join_tracks(tracks, views, np.array([[0, 3]]))
        assert as_sets(joined) == as_sets(tracks)

    def test_of_conflicting_correspondences_those_named_most_win(self):
        # The middle track corresponds with two tracks that share frame 0.
        tracks, views = tracks_over([0], [0, 1], [5, 6])
        first, second, middle = (tracks[index] for index in range(3))
        matches = np.array([[first[0], middle[0]], [second[0], middle[0]], [second[1], middle[1]]])
        joined = join_tracks(tracks, views, matches)
        assert as_sets(joined) == {
            frozenset(first.tolist()),
            frozenset(second.tolist()) | frozenset(middle.tolist()),
        }

    def test_correspondences_within_a_track_change_nothing(self):
        tracks, views = tracks_over([0, 3], [5])
        joined = join_tracks(tracks, views, np.array([[0, 1]]))
        assert as_sets(joined) == as_sets(tracks)

    def test_observations_without_a_track_are_passed_over(self):
        tracks, views = tracks_over([0], [1], [2])
        some = tracks.take(np.array([0, 2]))
        joined = join_tracks(some, views, np.array([[0, 1], [1, 2]]))
        assert as_sets(joined) == as_sets(some)

    def test_no_correspondences_change_nothing(self):
        tracks, views = tracks_over([0, 3], [5])
        joined = join_tracks(tracks, views, np.empty((0, 2), np.int64))
        assert as_sets(joined) == as_sets(tracks)

    @given(st.data())
    def test_the_order_of_correspondences_does_not_matter(self, data):
        count = data.draw(st.integers(2, 8))
        # One frame each: nothing conflicts, and the result is that of connected components.
        tracks, views = tracks_over(*[[index] for index in range(count)])
        pair = st.tuples(st.integers(0, count - 1), st.integers(0, count - 1))
        matches = data.draw(st.lists(pair, max_size=10))
        shuffled = [
            data.draw(st.sampled_from([(a, b), (b, a)]))
            for a, b in data.draw(st.permutations(matches))
        ]
        groups = [{index} for index in range(count)]
        for a, b in matches:
            together = next(g for g in groups if a in g) | next(g for g in groups if b in g)
            groups = [group for group in groups if not group & together] + [together]
        for order in (matches, shuffled):
            joined = join_tracks(tracks, views, np.array(order, np.int64).reshape(-1, 2))
            assert as_sets(joined) == {frozenset(group) for group in groups}

    @given(st.data())
    def test_no_track_ever_has_two_observations_of_a_frame(self, data):
        frames = st.lists(st.integers(0, 9), min_size=1, max_size=4, unique=True).map(sorted)
        tracks, views = tracks_over(*data.draw(st.lists(frames, min_size=2, max_size=8)))
        observation = st.integers(0, len(views) - 1)
        matches = data.draw(st.lists(st.tuples(observation, observation), max_size=20))
        joined = join_tracks(tracks, views, np.array(matches, np.int64).reshape(-1, 2))
        np.testing.assert_array_equal(np.sort(joined.observation), np.arange(len(views)))
        for index in range(len(joined)):
            frames_seen = views.frame[joined[index]]
            assert len(set(frames_seen.tolist())) == len(frames_seen)
