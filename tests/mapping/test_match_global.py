import dataclasses

import numpy as np
import pytest

from roel_service.config.stages import Config, MatchGlobalConfig, RefineRoundsConfig
from roel_service.errors import Cancelled
from roel_service.geometry import plucker, projection, segments
from roel_service.mapping.match_global import _exclusive, project_segments, reassociate
from roel_service.mapping.refine import refine_lines
from roel_service.scene.lines import InfiniteLines, LineTracks

from .synthetic import CAMERA, line_errors, observed, still_frames, world

# Polarities of the small world do not turn with the motion, as those of edges do.
CONFIG = Config(
    match_global=MatchGlobalConfig(one_side=False),
    refine_rounds=RefineRoundsConfig(event_weight=0.0),
)


def unwatched(done_count, total_count):
    """Progress that nobody looks at."""


def first_lines(world, tracks, lines):
    evidence = world.evidence(CONFIG.refine)
    return evidence, refine_lines(lines, tracks, evidence, world.frames, CONFIG.refine)


def reassociated(world, tracks, lines, config=CONFIG, progress=unwatched):
    evidence, refined = first_lines(world, tracks, lines)
    return reassociate(
        refined,
        evidence,
        world.observations,
        world.frames,
        world.trajectory,
        config,
        progress,
    )


def with_rounds(*distances_px, **changes):
    settings = MatchGlobalConfig(max_distances_px=distances_px, one_side=False, **changes)
    return dataclasses.replace(CONFIG, match_global=settings)


class TestReassociate:
    def test_broken_tracks_become_whole(self):
        exact = world()
        # Every line is known from its first eight views alone.
        tracks = LineTracks.from_lists([exact.tracks[j][:8] for j in range(12)])
        found = reassociated(exact, tracks, exact.lines)
        assert line_errors(found.lines, exact.segments).max() < 1e-6
        for j in range(12):
            np.testing.assert_array_equal(found.tracks[j], exact.tracks[j])

    def test_pieces_of_one_track_become_one_line(self):
        exact = world()
        pieces = [part for j in range(12) for part in np.split(exact.tracks[j], [8, 16])]
        lines = exact.lines.take(np.repeat(np.arange(12), 3))
        found = reassociated(exact, LineTracks.from_lists(pieces), lines)
        assert len(found) == 12
        np.testing.assert_array_equal(found.tracks.observation, exact.tracks.observation)

    def test_noisy_observations_find_their_lines(self):
        noisy = world(noise_px=0.3)
        tracks = LineTracks.from_lists([noisy.tracks[j][::3] for j in range(12)])
        found = reassociated(noisy, tracks, noisy.lines)
        line_of_row = noisy.line_of[found.tracks.observation]
        np.testing.assert_array_equal(line_of_row, found.tracks.track_of_row)
        # 1.1 px in the last round is more than three deviations of the worse of two ends.
        assert len(line_of_row) > 0.95 * len(noisy.line_of)

    def test_rounds_reach_as_far_as_they_say(self):
        exact = world()
        lines = exact.observations.segments_px.copy()
        late = np.arange(len(lines)) >= len(lines) // 2
        lines[late] += 1.2 * segments.left_normal(lines[late])[:, None]
        shifted = dataclasses.replace(
            exact, observations=dataclasses.replace(exact.observations, segments_px=lines)
        )
        tracks = LineTracks.from_lists([exact.tracks[j][:12] for j in range(12)])
        near = reassociated(shifted, tracks, exact.lines, with_rounds(0.5))
        assert len(near.tracks.observation) == (~late).sum()
        far = reassociated(shifted, tracks, exact.lines, with_rounds(1.6))
        assert len(far.tracks.observation) > 1.5 * (~late).sum()

    def test_an_observation_moving_otherwise_belongs_to_another_line(self):
        exact = world()
        speeds = exact.observations.normal_speed_px_per_ms.copy()
        odd = np.arange(len(speeds)) % 5 == 3
        speeds[odd] += 0.1
        moving = dataclasses.replace(
            exact,
            observations=dataclasses.replace(exact.observations, normal_speed_px_per_ms=speeds),
        )
        rows = [exact.tracks[j][~odd[exact.tracks[j]]][:8] for j in range(12)]
        tracks = LineTracks.from_lists(rows)
        found = reassociated(moving, tracks, exact.lines)
        assert not odd[found.tracks.observation].any()
        assert len(found.tracks.observation) == (~odd).sum()
        # Speeds can be predicted only where the camera's rotation was undone.
        turning = dataclasses.replace(
            CONFIG, frames=dataclasses.replace(CONFIG.frames, compensate_rotation=False)
        )
        blind = reassociated(moving, tracks, exact.lines, turning)
        assert len(blind.tracks.observation) == len(odd)
        slack = with_rounds(1.5, max_speed_difference_px_per_ms=0.2)
        assert len(reassociated(moving, tracks, exact.lines, slack).tracks.observation) == len(odd)

    def test_predicted_speeds_are_those_of_exact_lines(self):
        """A gate far below the speeds themselves lets all exact observations through."""
        exact = world()
        tight = with_rounds(1.5, max_speed_difference_px_per_ms=2e-3)
        tracks = LineTracks.from_lists([exact.tracks[j][:8] for j in range(12)])
        found = reassociated(exact, tracks, exact.lines, tight)
        assert len(found.tracks.observation) == len(exact.line_of)
        assert np.abs(exact.observations.normal_speed_px_per_ms).max() > 0.05

    @pytest.mark.parametrize("sign", [1, -1])
    def test_directions_of_segments_and_lines_do_not_matter(self, sign):
        exact = world()
        flipped = dataclasses.replace(
            exact.observations,
            segments_px=exact.observations.segments_px[:, ::-1],
            normal_speed_px_per_ms=-exact.observations.normal_speed_px_per_ms,
        )
        turned = dataclasses.replace(exact, observations=flipped)
        lines = InfiniteLines(
            direction=sign * exact.lines.direction, moment=sign * exact.lines.moment
        )
        tracks = LineTracks.from_lists([exact.tracks[j][:8] for j in range(12)])
        found = reassociated(turned, tracks, lines)
        np.testing.assert_array_equal(found.tracks.observation, exact.tracks.observation)

    def test_observations_must_face_the_line(self):
        exact = world(lines=(2,))
        lines = exact.observations.segments_px.copy()
        # The second half of the frames sees the edge's continuation, a tenth of it facing.
        lines[12:] += 0.9 * (lines[12:, 1] - lines[12:, 0])[:, None]
        beyond = dataclasses.replace(
            exact, observations=dataclasses.replace(exact.observations, segments_px=lines)
        )
        tracks = LineTracks.from_lists([exact.tracks[0][:12]])
        strict = reassociated(beyond, tracks, exact.lines, with_rounds(1.5, min_overlap=0.4))
        assert len(strict.tracks.observation) == 12
        slack = with_rounds(1.5, min_overlap=0.05, max_speed_difference_px_per_ms=1.0)
        assert len(reassociated(beyond, tracks, exact.lines, slack).tracks.observation) == 24


class TestExclusive:
    def test_every_observation_supports_at_most_one_line(self):
        noisy = world(noise_px=0.5)
        # Every line twice, the second one a little beside the first.
        moment = noisy.lines.moment * 1.001
        lines = InfiniteLines(
            direction=np.concatenate([noisy.lines.direction] * 2),
            moment=np.concatenate([noisy.lines.moment, moment]),
        )
        tracks = LineTracks.from_lists([noisy.tracks[j % 12][j // 12 :: 2] for j in range(24)])
        found = reassociated(noisy, tracks, lines)
        assert found.tracks.is_exclusive()

    def test_shared_observations_leave_the_larger_line(self):
        exact = world()
        rows = [exact.tracks[3], exact.tracks[3][:10], exact.tracks[5]]
        lines = exact.lines.take(np.array([3, 3, 5]))
        found = reassociated(exact, LineTracks.from_lists(rows), lines)
        assert line_errors(found.lines, exact.segments[[3, 5]]).max() < 1e-6
        np.testing.assert_array_equal(found.tracks.sizes, [24, 24])

    def test_sharing_is_tolerated_up_to_its_limit_and_then_the_better_line_wins(self):
        exact = world(lines=(3,))
        lines = exact.lines.take(np.array([0, 0]))
        rows = LineTracks.from_lists([exact.tracks[0], exact.tracks[0][:10]])
        config = with_rounds(1.5, max_shared_fraction=1.0)
        found = reassociated(exact, rows, lines, config)
        # None shares more than all: both stay in the rounds, and one gets everything in the end.
        np.testing.assert_array_equal(found.tracks.sizes, [24])

    @pytest.mark.parametrize(("size", "winner"), [(3, 0), (24, 1)])
    def test_a_large_line_wins_against_a_slightly_better_small_one(self, size, winner):
        exact = world(lines=(3,))
        tracks = LineTracks.from_lists([exact.tracks[0], exact.tracks[0][:size]])
        _, refined = first_lines(exact, tracks, exact.lines.take(np.array([0, 0])))
        # The larger line is 6 mm, some 0.3 px, off; ln(24 / 3) counts for 0.6 px.
        beside = exact.segments + np.array([0.006, 0.0, 0.0])
        direction, moment = plucker.plucker_from_endpoints(np.concatenate([beside, exact.segments]))
        lines = InfiniteLines(direction=direction, moment=moment)
        refined = dataclasses.replace(refined, lines=lines, tracks=tracks)
        found = _exclusive(refined, exact.views, exact.frames)
        assert found.is_exclusive()
        assert np.argmax(found.sizes) == winner
        assert found.sizes.max() == 24


class TestDegenerate:
    def test_no_lines_stay_no_lines(self):
        exact = world()
        nothing = InfiniteLines(direction=np.empty((0, 3)), moment=np.empty((0, 3)))
        assert len(reassociated(exact, LineTracks.from_lists([]), nothing)) == 0

    def test_no_observations_keep_no_lines(self):
        exact = world()
        empty = dataclasses.replace(exact, observations=observed(), line_of=np.empty(0, int))
        nothing = InfiniteLines(direction=np.empty((0, 3)), moment=np.empty((0, 3)))
        assert len(reassociated(empty, LineTracks.from_lists([]), nothing)) == 0

    def test_progress_is_told_once_a_round_and_may_cancel(self):
        exact = world()
        told = []
        reassociated(exact, exact.tracks, exact.lines, progress=lambda *counts: told.append(counts))
        assert told == [(0, 3), (1, 3), (2, 3)]

        def cancel(done_count, total_count):
            raise Cancelled

        with pytest.raises(Cancelled):
            reassociated(exact, exact.tracks, exact.lines, progress=cancel)


class TestProjectSegments:
    FRAMES = still_frames(1)

    def projected(self, *points):
        T_camera_world = self.FRAMES.T_world_camera[0].inverse()
        return project_segments(np.array([points], float), T_camera_world, self.FRAMES)[0]

    def test_a_segment_in_view_is_its_projection(self):
        ends = np.array([[-0.3, 0.1, 2.0], [0.4, -0.2, 3.0]])
        expected = projection.project(ends, CAMERA.matrix)
        np.testing.assert_allclose(self.projected(*ends), expected, rtol=0, atol=1e-12)

    def test_the_part_behind_the_camera_is_cut_off(self):
        found = self.projected([0.1, 0.1, 2.0], [0.1, 0.1, -2.0])
        assert np.isfinite(found).all()
        np.testing.assert_allclose(
            found[0], projection.project(np.array([0.1, 0.1, 2.0]), CAMERA.matrix)
        )
        # The far end lies on the same ray's image, towards the lower right.
        assert (found[1] > found[0]).all()

    @pytest.mark.parametrize(
        "ends",
        [
            ([0, 0, -1.0], [0.5, 0, -2.0]),
            ([5.0, 0, 1.0], [6.0, 0, 1.0]),
            ([0, 0, 100.0], [0.5, 0, 100.0]),
            ([np.nan] * 3, [np.nan] * 3),
        ],
        ids=["behind", "beside the image", "shorter than 5 px", "unknown"],
    )
    def test_what_is_not_to_be_seen_is_nan(self, ends):
        assert np.isnan(self.projected(*ends)).all()
