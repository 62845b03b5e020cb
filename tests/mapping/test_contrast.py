import dataclasses

import numpy as np
import pytest

from roel_service.config.stages import MatchGlobalConfig
from roel_service.geometry import plucker, projection
from roel_service.geometry.segments import left_normal
from roel_service.mapping.contrast import bright_sides, sides_of_lines, with_one_side
from roel_service.mapping.match_global import reassociate
from roel_service.mapping.refine import refine_lines
from roel_service.scene.lines import LineTracks

from .synthetic import world
from .test_match_global import CONFIG, unwatched


def seen(exact, polarity, speed):
    return dataclasses.replace(
        exact.observations,
        polarity=np.broadcast_to(polarity, len(exact.line_of)).astype(np.int8),
        normal_speed_px_per_ms=np.broadcast_to(speed, len(exact.line_of)).astype(np.float64),
    )


def sides(exact, observations, *, rotation_is_undone=False):
    return bright_sides(
        observations, exact.frames, exact.trajectory, rotation_is_undone=rotation_is_undone
    )


class TestBrightSides:
    @pytest.mark.parametrize(
        ("polarity", "speed", "side"),
        [(1, 0.2, -1), (-1, 0.2, 1), (1, -0.2, 1), (-1, -0.2, -1), (0, 0.2, 0), (1, 0.01, 0)],
    )
    def test_they_lie_behind_an_edge_that_brightens(self, polarity, speed, side):
        exact = world()
        np.testing.assert_array_equal(sides(exact, seen(exact, polarity, speed)), side)

    def test_the_turn_of_the_camera_is_part_of_the_speed(self):
        """Exact lines, whose whole motion is that of their images a millisecond later."""
        exact = world()
        speed = exact.observations.normal_speed_px_per_ms
        observations = seen(exact, 1, speed)
        found = sides(exact, observations, rotation_is_undone=True)
        segments = exact.observations.segments_px
        later = exact.trajectory.interpolate(exact.frames.t_us + 1_000)
        in_camera = later.inverse()[:, None, None] @ exact.segments
        moved = projection.project(in_camera, exact.frames.K)
        moved = moved[exact.observations.frame, exact.line_of]
        left = left_normal(segments)
        whole = np.sum((moved.mean(axis=1) - segments.mean(axis=1)) * left, axis=-1)
        known = found != 0
        assert known.sum() > 40
        np.testing.assert_array_equal(found[known], -np.sign(whole[known]))

    def test_a_line_keeps_its_side_whichever_way_it_moves(self):
        exact = world()
        line = np.where(np.arange(len(exact.line_of)) % 2, 0.2, -0.2)
        observations = seen(exact, np.sign(line), line)
        found = sides(exact, observations)
        assert (found == -1).all()


def along_lines(exact, side):
    """(M,) bright sides of segments that see (M,) those of their lines."""
    views, line = exact.evidence(CONFIG.refine).views, exact.line_of
    moment = plucker.shift_origin(
        exact.lines.direction[line], exact.lines.moment[line], views.centre
    )
    return (side * np.sign(np.sum(views.normal * moment, axis=-1))).astype(np.int64)


class TestOneSide:
    def test_most_observations_tell_the_side_of_a_line(self):
        exact = world()
        flank = np.where(np.arange(len(exact.line_of)) % 5 == 3, -1, 1)
        bright = along_lines(exact, flank)
        views = exact.evidence(CONFIG.refine).views
        tracks = LineTracks.from_lists([exact.tracks[j] for j in range(12)])
        own = sides_of_lines(tracks, exact.lines, views, bright)
        np.testing.assert_array_equal(own, 1)
        kept = with_one_side(tracks, exact.lines, views, bright, own)
        np.testing.assert_array_equal(np.sort(kept.observation), np.flatnonzero(flank == 1))

    @pytest.mark.parametrize("one_side", [True, False])
    def test_lines_leave_the_other_flank_alone(self, one_side):
        exact = world()
        flank = np.where(np.arange(len(exact.line_of)) % 5 == 3, -1, 1)
        speed = exact.observations.normal_speed_px_per_ms
        way = sides(exact, seen(exact, -1, speed), rotation_is_undone=True)
        observations = seen(exact, -along_lines(exact, flank) * way, speed)
        tracks = LineTracks.from_lists(
            [exact.tracks[j][flank[exact.tracks[j]] == 1][:8] for j in range(12)]
        )
        config = dataclasses.replace(CONFIG, match_global=MatchGlobalConfig(one_side=one_side))
        evidence = exact.evidence(config.refine)
        refined = refine_lines(exact.lines, tracks, evidence, exact.frames, config.refine)
        found = reassociate(
            refined, evidence, observations, exact.frames, exact.trajectory, config, unwatched
        )
        # Of slow ones nothing is said.
        other = (flank == -1) & (way != 0)
        assert other.sum() > 10
        expected = np.flatnonzero(~other) if one_side else np.arange(len(flank))
        np.testing.assert_array_equal(np.sort(found.tracks.observation), expected)
