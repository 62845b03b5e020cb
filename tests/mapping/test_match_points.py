import dataclasses
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from roel_service.config.stages import Config, DetectConfig, FramesConfig, MatchGlobalConfig
from roel_service.errors import ConfigError
from roel_service.geometry.projection import undistortion_table
from roel_service.geometry.segments import point_segment_distance
from roel_service.mapping.frames import event_frame
from roel_service.mapping.match_points import (
    KEPT_FRAME_COUNT,
    PointLineMatcher,
    images_to_match,
    lines_near_matches,
    point_matcher,
)
from roel_service.mapping.match_sampled import match_sampled_frames
from roel_service.mapping.representations import event_images
from roel_service.scene.lines import LineTracks

from .synthetic import CAMERA, event_stream, trajectory, world

CONFIG = MatchGlobalConfig(
    method="sampled", matcher="xfeat", min_point_match_count=11, point_distance_px=10.0
)
LEVEL = np.array([[20.0, 40.0], [100.0, 40.0]])
UPRIGHT = np.array([[60.0, 70.0], [60.0, 110.0]])


def matches_between(points_i, points_j):
    return np.hstack([points_i, points_j])


def along(segment, count):
    return segment[0] + np.linspace(0, 1, count)[:, None] * (segment[1] - segment[0])


class TestLinesNearMatches:
    def pairs(self, matches, config=CONFIG):
        return lines_near_matches(
            matches, np.stack([LEVEL, UPRIGHT]), np.stack([UPRIGHT, LEVEL]), config
        ).tolist()

    def test_more_than_ten_matches_near_both_make_a_pair(self):
        matches = matches_between(along(LEVEL, 11), along(LEVEL, 11))
        assert self.pairs(matches) == [[0, 1]]
        assert self.pairs(matches[:10]) == []

    def test_every_line_has_its_own_pair(self):
        matches = np.concatenate(
            [
                matches_between(along(LEVEL, 11), along(LEVEL, 11)),
                matches_between(along(UPRIGHT, 11), along(UPRIGHT, 11)),
            ]
        )
        assert self.pairs(matches) == [[0, 1], [1, 0]]

    def test_a_match_near_a_line_in_one_image_alone_does_not_count(self):
        far = along(LEVEL, 11) - np.array([0.0, 30.0])
        assert self.pairs(matches_between(along(LEVEL, 11), far)) == []
        assert self.pairs(matches_between(far, along(LEVEL, 11))) == []

    @pytest.mark.parametrize(("offset_px", "near"), [(10.0, True), (10.001, False)])
    def test_near_is_within_the_distance(self, offset_px, near):
        beside = along(LEVEL, 11) - np.array([0.0, offset_px])
        assert bool(self.pairs(matches_between(beside, along(LEVEL, 11)))) is near
        # Beyond the end it is the end that counts, not the infinite line.
        beyond = np.tile(LEVEL[1] + [offset_px, 0.0], (11, 1))
        assert bool(self.pairs(matches_between(beyond, along(LEVEL, 11)))) is near

    def test_without_matches_or_lines_there_are_no_pairs(self):
        none = np.empty((0, 2, 2))
        assert lines_near_matches(np.empty((0, 4)), LEVEL[None], LEVEL[None], CONFIG).shape == (
            0,
            2,
        )
        matches = matches_between(along(LEVEL, 11), along(LEVEL, 11))
        assert lines_near_matches(matches, none, LEVEL[None], CONFIG).shape == (0, 2)

    @given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.floats(1.0, 60.0))
    def test_it_is_what_counting_one_by_one_gives(self, seed, min_count, distance_px):
        rng = np.random.default_rng(seed)
        matches = rng.uniform(0, 100, (20, 4))
        segments_i, segments_j = rng.uniform(0, 100, (2, 4, 2, 2))
        config = dataclasses.replace(
            CONFIG, min_point_match_count=min_count, point_distance_px=distance_px
        )
        expected = [
            [i, j]
            for i in range(4)
            for j in range(4)
            if sum(
                point_segment_distance(match[:2], segments_i[i]) <= distance_px
                and point_segment_distance(match[2:], segments_j[j]) <= distance_px
                for match in matches
            )
            >= min_count
        ]
        assert lines_near_matches(matches, segments_i, segments_j, config).tolist() == expected


class TruePoints:
    """A point matcher that knows 3D points; an "image" is the number of its frame."""

    def __init__(self, exact, points_world):
        self.exact = exact
        self.points_world = points_world
        self.asked = []

    def features(self, grey):
        frame = int(grey[0, 0])
        self.asked.append(frame)
        T_camera_world = self.exact.frames.T_world_camera[frame].inverse()
        points_camera = T_camera_world @ self.points_world
        return (
            points_camera[:, :2] / points_camera[:, 2:] @ self.exact.frames.K[:2, :2].T
            + (self.exact.frames.K[:2, 2])
        )

    def match(self, features_i, features_j):
        return np.hstack([features_i, features_j])


def numbered_images(frame_count, representation_count=1):
    return {
        frame: tuple(np.full((1, 1), frame, np.uint8) for _ in range(representation_count))
        for frame in range(frame_count)
    }


def points_on(exact, count):
    """Points at the middle of every segment, and `count` in all."""
    return np.concatenate([along(segment, count + 2)[1:-1] for segment in exact.segments])


# Lines of this small image are closer to each other than the paper's 10 px.
NARROW = dataclasses.replace(CONFIG, point_distance_px=1.0, frame_stride=5)


class TestPointLineMatcher:
    def matcher(self, exact, count=11, config=NARROW, images=None):
        points = TruePoints(exact, points_on(exact, count))
        images = images or numbered_images(len(exact.frames))
        return PointLineMatcher(points, images, exact.views, config)

    def test_lines_with_points_in_common_correspond(self):
        exact = world()
        found = self.matcher(exact).match(0, 10)
        np.testing.assert_array_equal(exact.observations.frame[found], [[0, 10]] * len(found))
        np.testing.assert_array_equal(exact.line_of[found[:, 0]], exact.line_of[found[:, 1]])
        in_both = np.intersect1d(
            exact.line_of[exact.observations.frame == 0],
            exact.line_of[exact.observations.frame == 10],
        )
        assert len(found) == len(in_both) > 5

    def test_matches_of_all_representations_are_pooled(self):
        exact = world()
        assert len(self.matcher(exact, count=6).match(0, 10)) == 0
        two = numbered_images(len(exact.frames), representation_count=2)
        assert len(self.matcher(exact, count=6, images=two).match(0, 10)) > 5

    def test_correspondences_make_broken_tracks_whole(self):
        exact = world()
        pieces = LineTracks.from_lists(
            [part for j in range(12) for part in np.split(exact.tracks[j], [8, 16])]
        )
        config = Config(match_global=NARROW)
        joined = match_sampled_frames(
            pieces, exact.views, exact.frames, config, self.matcher(exact), lambda *counts: None
        )
        assert len(joined) == 12

    def test_an_image_is_looked_at_once(self):
        exact = world()
        matcher = self.matcher(exact)
        for pair in [(0, 5), (0, 10), (5, 10)]:
            matcher.match(*pair)
        assert matcher._points.asked == [0, 5, 10]

    def test_the_features_of_frames_long_ago_are_let_go(self):
        exact = world()
        images = numbered_images(KEPT_FRAME_COUNT + 1)
        last = len(exact.frames) - 1
        images |= {frame: images[frame % last] for frame in images}
        matcher = self.matcher(exact, images=images)
        for frame in range(1, KEPT_FRAME_COUNT + 1):
            matcher.match(0, frame)
        # Frame 0 was used all along; frame 1 made room.
        asked_count = len(matcher._points.asked)
        matcher.match(0, KEPT_FRAME_COUNT)
        assert len(matcher._points.asked) == asked_count == KEPT_FRAME_COUNT + 1
        matcher.match(0, 1)
        assert len(matcher._points.asked) == asked_count + 1

    def test_a_frame_without_events_has_no_correspondences(self):
        exact = world()
        images = {**numbered_images(len(exact.frames)), 10: ()}
        assert self.matcher(exact, images=images).match(0, 10).shape == (0, 2)


class TestImages:
    def frame(self):
        return event_frame(
            event_stream(),
            1_000_000,
            undistortion_table(CAMERA),
            trajectory(),
            CAMERA,
            FramesConfig(),
            DetectConfig(),
        )

    def test_sampled_frames_give_the_representations_of_the_longest_window(self):
        frame = self.frame()
        detect = DetectConfig(representations=("binary", "timestamp"))
        config = Config(detect=detect, match_global=dataclasses.replace(CONFIG, frame_stride=5))
        images = images_to_match(10, frame, config)
        longest = [image.grey for image in event_images(frame, detect)][-3:]
        assert len(images) == 3
        for image, expected in zip(images, longest, strict=True):
            assert image.dtype == np.uint8
            np.testing.assert_array_equal(image, expected)
        assert images_to_match(11, frame, config) == ()

    @pytest.mark.parametrize(
        "changes", [{"matcher": "geometric"}, {"method": "reassociate"}, {"method": "none"}]
    )
    def test_nothing_is_kept_when_no_points_are_matched(self, changes):
        config = Config(match_global=dataclasses.replace(CONFIG, **changes))
        assert images_to_match(0, self.frame(), config) == ()


def test_without_the_extra_the_error_names_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "kornia", None)
    with pytest.raises(ConfigError) as caught:
        point_matcher(CONFIG)
    assert str(caught.value) == (
        "match_global.matcher: expected the extra `learned` installed for xfeat: `make learned`, "
        "found no package kornia"
    )
