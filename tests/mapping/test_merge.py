import dataclasses

import numpy as np
import pytest

from roel_service.config.stages import RefineConfig, TriangulateConfig
from roel_service.geometry import plucker
from roel_service.geometry.se3 import rotation_from_vector
from roel_service.mapping.merge import merge_duplicates
from roel_service.mapping.refine import refine_lines
from roel_service.scene.lines import InfiniteLines, LineTracks
from roel_service.scene.results import TrackStatus

from .synthetic import world

CONFIG = TriangulateConfig(merge=True)
KEEP_ALL = RefineConfig(event_weight=0.0, max_residual_px=1e6, iteration_count=1)


def refined_at(exact, segments_world, rows):
    """Lines through these segments with these observations, as they stand."""
    direction, moment = plucker.plucker_from_endpoints(np.asarray(segments_world))
    lines = InfiniteLines(direction=direction, moment=moment)
    found = refine_lines(
        lines, LineTracks.from_lists(rows), exact.evidence(KEEP_ALL), exact.frames, KEEP_ALL
    )
    return dataclasses.replace(found, lines=lines)


def merged(exact, segments_world, rows, config=CONFIG):
    found = refined_at(exact, segments_world, rows)
    kept, dropped = merge_duplicates(found, exact.views, exact.frames, config)
    return kept, dropped


def turned(segment, angle_rad):
    """About its middle, in the plane of the image."""
    middle = segment.mean(axis=0)
    return middle + (segment - middle) @ rotation_from_vector(np.array([0, 0, angle_rad])).T


class TestMerge:
    def test_different_lines_all_stay(self):
        exact = world()
        kept, dropped = merged(exact, exact.segments, [exact.tracks[j] for j in range(12)])
        assert len(kept) == 12
        assert dropped == []

    def test_of_equal_lines_the_longest_stays(self):
        exact = world(lines=(1,))
        short = exact.observations.segments_px.copy()
        # Odd frames saw the first half alone.
        short[1::2, 1] = short[1::2].mean(axis=1)
        halved = dataclasses.replace(
            exact, observations=dataclasses.replace(exact.observations, segments_px=short)
        )
        rows = [np.arange(1, 24, 2), np.arange(0, 24, 2)]
        # Lengths differ by a half, centres by a quarter: some 11 px.
        for order in ([0, 1], [1, 0]):
            kept, dropped = merged(halved, exact.segments[[0, 0]], [rows[index] for index in order])
            assert dropped == [TrackStatus.MERGED]
            np.testing.assert_array_equal(kept.tracks[0], rows[1])

    @pytest.mark.parametrize(
        ("change", "merges"),
        [({}, True), ({"merge_angle_deg": 0.5}, False)],
    )
    def test_directions_must_agree(self, change, merges):
        exact = world(lines=(1,))
        lines = [exact.segments[0], turned(exact.segments[0], np.deg2rad(1.0))]
        rows = [np.arange(0, 24, 2), np.arange(1, 24, 2)]
        _, dropped = merged(exact, lines, rows, dataclasses.replace(CONFIG, **change))
        assert (dropped == [TrackStatus.MERGED]) is merges

    @pytest.mark.parametrize(
        ("change", "merges"),
        [({}, True), ({"merge_disparity_px": 0.1}, False)],
    )
    def test_disparities_must_agree(self, change, merges):
        exact = world(lines=(1,))
        # A little farther away on the same rays: 5 % of some 15 px of disparity.
        centre = exact.frames.T_world_camera.translation.mean(axis=0)
        lines = [exact.segments[0], centre + 1.05 * (exact.segments[0] - centre)]
        rows = [np.arange(0, 24, 2), np.arange(1, 24, 2)]
        _, dropped = merged(exact, lines, rows, dataclasses.replace(CONFIG, **change))
        assert (dropped == [TrackStatus.MERGED]) is merges

    @pytest.mark.parametrize(
        ("change", "merges"),
        [({}, True), ({"merge_center_px": 2.0}, False)],
    )
    def test_centres_must_agree(self, change, merges):
        exact = world(lines=(1,))
        # 0.15 m aside at 2.5 m: 7 px.
        lines = [exact.segments[0], exact.segments[0] + [0.0, 0.15, 0.0]]
        rows = [np.arange(0, 24, 2), np.arange(1, 24, 2)]
        _, dropped = merged(exact, lines, rows, dataclasses.replace(CONFIG, **change))
        assert (dropped == [TrackStatus.MERGED]) is merges

    def test_neighbours_of_neighbours_are_one_cluster(self):
        exact = world(lines=(1,))
        steps = [exact.segments[0] + [0.0, 0.1 * index, 0.0] for index in range(4)]
        rows = [np.arange(index, 24, 4) for index in range(4)]
        # 5 px from one to the next, 15 px from the first to the last.
        config = dataclasses.replace(CONFIG, merge_center_px=8.0)
        _, dropped = merged(exact, steps, rows, config)
        assert dropped == [TrackStatus.MERGED] * 3
        _, dropped = merged(exact, [steps[0], steps[3]], rows[:2], config)
        assert dropped == []

    def test_scale_does_not_matter(self):
        counts = []
        for scale in (1.0, 100.0):
            exact = world(scale, lines=(1,))
            lines = [exact.segments[0], exact.segments[0] + [0.0, 0.15 * scale, 0.0]]
            rows = [np.arange(0, 24, 2), np.arange(1, 24, 2)]
            counts.append(len(merged(exact, lines, rows)[0]))
        assert counts == [1, 1]

    def test_no_lines_stay_no_lines(self):
        exact = world()
        kept, dropped = merged(exact, np.empty((0, 2, 3)), [])
        assert (len(kept), dropped) == (0, [])

    def test_lines_without_a_covered_part_stay_apart(self):
        exact = world()
        # Observations of other lines, behind which these lines do not lie.
        away = exact.segments[[0, 0]] + np.array([0.0, 0.0, -10.0])
        kept, dropped = merged(exact, away, [exact.tracks[0][:5], exact.tracks[0][5:9]])
        assert (len(kept), dropped) == (2, [])
