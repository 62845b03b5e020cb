import dataclasses

import numpy as np
import pytest

from roel_service.config.stages import RefineConfig, TrimConfig
from roel_service.geometry import plucker, projection
from roel_service.geometry.se3 import SE3
from roel_service.mapping.evidence import Evidence
from roel_service.mapping.moments import segment_forms
from roel_service.mapping.refine import refine_lines
from roel_service.mapping.trim import (
    LEAST_NOISE_PX,
    _without_overlaps,
    covered_spans,
    trim_to_segments,
)
from roel_service.mapping.views import views_of
from roel_service.scene.lines import InfiniteLines, LineTracks
from roel_service.scene.results import TrackStatus

from .synthetic import SEGMENTS_WORLD, frames_of, observed, world, world_of

# Everything passes: each test closes the gate it is about.
OPEN = TrimConfig(max_error_m=1e6, min_coverage_count=1)
LINES_ONLY = RefineConfig(event_weight=0.0)


def refined(world, tracks=None, lines=None):
    """True lines with their information, from lines alone."""
    return refine_lines(
        world.lines if lines is None else lines,
        world.tracks if tracks is None else tracks,
        world.evidence(LINES_ONLY),
        world.frames,
        LINES_ONLY,
    )


def trimmed(world, config=OPEN, tracks=None, lines=None):
    return trim_to_segments(refined(world, tracks, lines), world.views, world.frames, config)


def assert_same_segments(found, truth, atol):
    """Equal sets of undirected segments."""
    assert len(found) == len(truth)
    for segment in truth:
        along = np.abs(found - segment).max(axis=(1, 2))
        against = np.abs(found - segment[::-1]).max(axis=(1, 2))
        assert np.minimum(along, against).min() < atol


class TestEnds:
    @pytest.mark.parametrize("method", ["coverage", "cluster"])
    @pytest.mark.parametrize("scale", [1.0, 100.0])
    def test_exact_observations_give_exact_ends(self, method, scale):
        exact = world(scale)
        line_map, dropped = trimmed(exact, dataclasses.replace(OPEN, method=method))
        assert dropped == []
        assert_same_segments(line_map.segments, exact.segments, atol=1e-9 * scale)

    @pytest.mark.parametrize("method", ["coverage", "cluster"])
    def test_columns_belong_to_their_segments(self, method):
        exact = world(noise_px=0.1)
        # Line j is seen in 6 + j frames.
        tracks = LineTracks.from_lists([exact.tracks[j][: 6 + j] for j in range(12)])
        found = refined(exact, tracks)
        line_map, _ = trim_to_segments(
            found, exact.views, exact.frames, dataclasses.replace(OPEN, method=method)
        )
        assert line_map.observation_count.sum() == len(found.tracks.observation)
        for j in range(12):
            row = int(np.flatnonzero(line_map.rms_residual_px == np.float32(found.rms_px[j]))[0])
            _, moment = plucker.plucker_from_endpoints(line_map.segments[row])
            np.testing.assert_allclose(
                np.abs(moment), np.abs(found.lines.moment[j]), rtol=0, atol=1e-9
            )
            assert line_map.observation_count[row] == len(found.tracks[j])

    def test_clusters_outvote_ends_that_were_cut_short(self):
        exact = world(lines=(2,))
        ends = exact.observations.segments_px.copy()
        # A third of the views see only the first half of the edge.
        ends[::3, 1] = ends[::3].mean(axis=1)
        observations = dataclasses.replace(exact.observations, segments_px=ends)
        shortened = dataclasses.replace(exact, observations=observations)
        cluster = dataclasses.replace(OPEN, method="cluster")
        line_map, _ = trimmed(shortened, cluster)
        assert_same_segments(line_map.segments, exact.segments, atol=1e-9)

    def test_the_width_of_a_cluster_is_in_pixels_at_the_viewing_distance(self):
        noisy = world(lines=(2,))
        ends = noisy.observations.segments_px.copy()
        along = (ends[:, 1] - ends[:, 0]) / np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)[:, None]
        # Ends in two groups of 16 and 8 views, 6 px apart.
        ends[::3, 1] -= 6.0 * along[::3]
        observations = dataclasses.replace(noisy.observations, segments_px=ends)
        found = {}
        for width_px in (1.0, 12.0):
            config = dataclasses.replace(OPEN, method="cluster", end_cluster_px=width_px)
            line_map, _ = trimmed(dataclasses.replace(noisy, observations=observations), config)
            found[width_px] = line_map.lengths_m[0]
        whole = np.linalg.norm(noisy.segments[0, 1] - noisy.segments[0, 0])
        assert found[1.0] == pytest.approx(whole, abs=1e-9)
        # One cluster: its median lies in the larger group, too, yet not at its edge.
        assert found[12.0] <= found[1.0] + 1e-9


class TestEndOn:
    """An edge 2 m long that leads away from the camera, within 9 degrees of its viewing rays."""

    EDGE = np.array([[[0.35, 0.1, 1.0], [0.35, 0.1, 3.0]]])

    @pytest.mark.parametrize(("max_foreshortening", "count"), [(5.0, 0), (50.0, 1)])
    def test_views_along_a_line_do_not_count(self, max_foreshortening, count):
        config = dataclasses.replace(OPEN, max_foreshortening=max_foreshortening)
        line_map, _ = trimmed(world_of(self.EDGE), config)
        assert len(line_map) == count

    def test_lines_seen_from_the_side_keep_their_ends(self):
        exact = world()
        line_map, _ = trimmed(exact, dataclasses.replace(OPEN, max_foreshortening=5.0))
        assert_same_segments(line_map.segments, exact.segments, atol=1e-9)


class TestPieces:
    """An edge 1 m long that is seen without its middle 20 cm."""

    EDGE = np.array([[-0.5, 0.1, 0.3], [0.5, 0.1, 0.3]])
    PIECES = EDGE[0] + np.array([[[0.0], [0.4]], [[0.6], [1.0]]]) * (EDGE[1] - EDGE[0])

    def seen(self, config):
        parts = world_of(self.PIECES)
        tracks = LineTracks.from_lists([np.arange(len(parts.observations))])
        line = InfiniteLines(direction=parts.lines.direction[:1], moment=parts.lines.moment[:1])
        return trimmed(parts, config, tracks, line)

    def test_a_line_seen_in_two_pieces_stays_two_pieces(self):
        line_map, dropped = self.seen(OPEN)
        assert_same_segments(line_map.segments, self.PIECES, atol=1e-9)
        assert dropped == []
        # Each is seen in every frame.
        np.testing.assert_array_equal(line_map.observation_count, [24, 24])

    @pytest.mark.parametrize("change", [{"max_gap_m": 0.25}, {"min_pixel_gap_px": 15.0}])
    def test_short_gaps_are_bridged(self, change):
        # 0.2 m at 2.3 m are 10 px.
        line_map, _ = self.seen(dataclasses.replace(OPEN, **change))
        assert_same_segments(line_map.segments, self.EDGE[None], atol=1e-9)

    def test_clusters_make_one_segment(self):
        line_map, _ = self.seen(dataclasses.replace(OPEN, method="cluster", min_length_m=1e-6))
        assert len(line_map) <= 1

    @pytest.mark.parametrize("change", [{"min_coverage_count": 6}, {"min_coverage_fraction": 0.5}])
    def test_parts_that_few_views_saw_are_left_out(self, change):
        parts = world_of(self.PIECES)
        # The first piece in all frames, the second in five.
        rows = np.concatenate([parts.tracks[0], parts.tracks[1][:5]])
        tracks = LineTracks.from_lists([np.sort(rows)])
        line = InfiniteLines(direction=parts.lines.direction[:1], moment=parts.lines.moment[:1])
        config = dataclasses.replace(OPEN, min_coverage_fraction=0.0)
        assert len(trimmed(parts, config, tracks, line)[0]) == 2
        line_map, _ = trimmed(parts, dataclasses.replace(config, **change), tracks, line)
        assert_same_segments(line_map.segments, self.PIECES[:1], atol=1e-9)


class TestStatus:
    @pytest.mark.parametrize(
        ("change", "status"),
        [
            ({"min_length_m": 5.0}, TrackStatus.TOO_SHORT),
            ({"min_coverage_count": 25}, TrackStatus.TOO_SHORT),
            ({"max_error_m": 1e-5}, TrackStatus.UNCERTAIN),
        ],
    )
    def test_every_gate_names_its_reason(self, change, status):
        noisy = world(noise_px=0.1)
        line_map, dropped = trimmed(noisy, dataclasses.replace(OPEN, **change))
        assert len(line_map) == 0
        assert dropped == [status] * 12

    @pytest.mark.parametrize("saw", [slice(None), slice(None, None, 3)])
    def test_the_error_to_expect_is_the_spread_of_its_own_noise_over_the_share_that_saw_it(
        self, saw
    ):
        noisy = world(noise_px=0.1)
        tracks = LineTracks.from_lists([noisy.tracks[0][saw]])
        line = noisy.lines.take(np.array([0]))
        found = trimmed(noisy, OPEN, tracks, line)[0]
        # 24 frames have it in view.
        support = len(tracks[0]) / 24
        error_m = float(found.sigma_m[0] * found.rms_residual_px[0]) / support
        for factor, kept in ((1.01, 1), (0.99, 0)):
            config = dataclasses.replace(OPEN, max_error_m=factor * error_m)
            assert len(trimmed(noisy, config, tracks, line)[0]) == kept

    def test_frames_that_look_elsewhere_do_not_count_against_a_line(self):
        exact = world()
        # Two thirds of the frames turn away: 90 degrees about the vertical axis.
        away = np.arange(24) % 3 > 0
        R = exact.frames.T_world_camera.rotation.copy()
        R[away] = R[away] @ np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
        pose = SE3(rotation=R, translation=exact.frames.T_world_camera.translation)
        frames = dataclasses.replace(exact.frames, T_world_camera=pose)
        tracks = LineTracks.from_lists([exact.tracks[0][~away]])
        found = refined(exact, tracks, exact.lines.take(np.array([0])))
        line_map, _ = trim_to_segments(found, exact.views, frames, OPEN)
        # The frames that look at it all saw it: its error is that of the least noise.
        error_m = float(line_map.sigma_m[0] * LEAST_NOISE_PX)
        config = dataclasses.replace(OPEN, max_error_m=1.01 * error_m)
        line_map, dropped = trim_to_segments(found, exact.views, frames, config)
        assert (len(line_map), dropped) == (1, [])

    def test_no_lines_give_an_empty_map(self):
        exact = world()
        nothing = InfiniteLines(direction=np.empty((0, 3)), moment=np.empty((0, 3)))
        for method in ("coverage", "cluster"):
            config = dataclasses.replace(OPEN, method=method)
            line_map, dropped = trimmed(exact, config, LineTracks.from_lists([]), nothing)
            assert (len(line_map), dropped) == (0, [])


class TestSigma:
    def sigma(self, segments_world, **changes):
        line_map, _ = trimmed(world_of(segments_world, **changes))
        return line_map.sigma_m

    def test_it_grows_with_the_distance(self):
        near = self.sigma(SEGMENTS_WORLD[9:10])
        # Twice as far from the cameras, which are 2 m before the origin, and twice as long.
        far = 2.0 * SEGMENTS_WORLD[9:10] + np.array([0.0, 0.0, 2.0])
        # Depth errors grow with the square of the distance, others with the distance.
        assert 2.5 < self.sigma(far)[0] / near[0] < 4.5

    def test_it_shrinks_with_the_root_of_the_number_of_views(self):
        few, many = (self.sigma(SEGMENTS_WORLD[9:10], frame_count=count) for count in (12, 48))
        assert few[0] / many[0] == pytest.approx(2.0, rel=0.1)

    def test_it_scales_with_the_world(self):
        small, large = (self.sigma(SEGMENTS_WORLD, scale=scale) for scale in (1.0, 100.0))
        np.testing.assert_allclose(np.sort(large), 100 * np.sort(small), rtol=1e-4)

    def test_it_does_not_depend_on_the_place_of_the_world_origin(self):
        here = world()
        shift = np.array([30.0, -20.0, 50.0])
        pose = here.frames.T_world_camera
        frames = dataclasses.replace(
            here.frames,
            T_world_camera=SE3(rotation=pose.rotation, translation=pose.translation + shift),
        )
        moved = dataclasses.replace(
            here,
            frames=frames,
            segments=here.segments + shift,
            trajectory=dataclasses.replace(
                here.trajectory,
                T_world_camera=SE3(
                    rotation=here.trajectory.T_world_camera.rotation,
                    translation=here.trajectory.T_world_camera.translation + shift,
                ),
            ),
        )
        expected, found = trimmed(here)[0], trimmed(moved)[0]
        np.testing.assert_allclose(np.sort(found.sigma_m), np.sort(expected.sigma_m), rtol=1e-4)

    def test_a_line_whose_depth_nothing_tells_is_uncertain(self):
        """All views from one place: the information has no entry for the distance."""
        frames = frames_of(
            SE3(rotation=np.tile(np.eye(3), (10, 1, 1)), translation=np.zeros((10, 3)))
        )
        segment = np.array([[-1.0, -0.2, 3.0], [1.0, 0.3, 3.5]])
        ends_px = projection.project(segment, frames.K)
        observations = observed(*[(index, ends_px) for index in range(10)])
        views = views_of(observations, frames)
        evidence = Evidence(
            views=views,
            event_forms=np.zeros((10, 6, 6)),
            segment_forms=segment_forms(observations, frames),
            event_counts=np.zeros(10, np.int64),
        )
        direction, moment = plucker.plucker_from_endpoints(segment[None])
        line = InfiniteLines(direction=direction, moment=moment)
        tracks = LineTracks.from_lists([np.arange(10)])
        found = refine_lines(line, tracks, evidence, frames, LINES_ONLY)
        # Rounding alone decides where along the rays a step ends; start and information matter.
        found = dataclasses.replace(found, lines=line)
        config = dataclasses.replace(OPEN, max_error_m=0.1)
        line_map, dropped = trim_to_segments(found, views, frames, config)
        assert (len(line_map), dropped) == (0, [TrackStatus.UNCERTAIN])


def left_of(*segments, **changes):
    """What stays of segments, strongest first, and of which it is."""
    config = dataclasses.replace(
        TrimConfig(overlap_distance_m=0.01, overlap_angle_deg=4.0, min_length_m=0.05), **changes
    )
    ends = np.array(segments, float).reshape(-1, 2, 3)
    return _without_overlaps(ends, config)


class TestOverlaps:
    STRONG = ((0.0, 0, 0), (1.0, 0, 0))

    def test_a_segment_along_a_stronger_one_goes(self):
        left, source = left_of(self.STRONG, ((0.2, 0.005, 0), (0.9, 0.005, 0)))
        np.testing.assert_array_equal(source, [0])
        np.testing.assert_array_equal(left[0], self.STRONG)

    def test_equal_segments_leave_one(self):
        assert left_of(self.STRONG, self.STRONG, self.STRONG[::-1])[1].tolist() == [0]

    def test_what_reaches_beyond_stays(self):
        left, source = left_of(self.STRONG, ((0.8, 0.005, 0), (1.5, 0.005, 0)))
        np.testing.assert_array_equal(source, [0, 1])
        np.testing.assert_allclose(left[1], [(1.0, 0.005, 0), (1.5, 0.005, 0)], rtol=0, atol=1e-12)

    def test_a_longer_one_is_split(self):
        left, source = left_of(self.STRONG, ((-0.5, 0.005, 0), (1.25, 0.005, 0)))
        np.testing.assert_array_equal(source, [0, 1, 1])
        np.testing.assert_allclose(left[1, :, 0], [-0.5, 0.0], rtol=0, atol=1e-12)
        np.testing.assert_allclose(left[2, :, 0], [1.0, 1.25], rtol=0, atol=1e-12)

    def test_short_rests_go(self):
        assert left_of(self.STRONG, ((0.5, 0, 0), (1.04, 0, 0)))[1].tolist() == [0]
        assert left_of(self.STRONG, ((0.5, 0, 0), (1.06, 0, 0)))[1].tolist() == [0, 1]

    def test_distance_and_angle_are_limits(self):
        assert len(left_of(self.STRONG, ((0, 0.02, 0), (1, 0.02, 0)))[0]) == 2
        wide = left_of(self.STRONG, ((0, 0.02, 0), (1, 0.02, 0)), overlap_distance_m=0.03)
        assert len(wide[0]) == 1
        # 5 degrees: a slope of 0.087.
        slanted = ((0.5, 0.0, 0), (0.6, 0.00875, 0))
        assert len(left_of(self.STRONG, slanted)[0]) == 2
        assert len(left_of(self.STRONG, slanted, overlap_angle_deg=6.0)[0]) == 1

    def test_only_the_close_part_of_a_slanted_one_goes(self):
        # Leaves the strip of 0.01 m at half of its length.
        left, _ = left_of(self.STRONG, ((0, 0, 0), (0.8, 0.02, 0)))
        np.testing.assert_allclose(left[1], [(0.4, 0.01, 0), (0.8, 0.02, 0)], rtol=0, atol=1e-9)

    def test_several_stronger_ones_hide_together(self):
        parts = [((0.0, 0, 0), (0.5, 0, 0)), ((0.5, 0, 0), (1.0, 0, 0))]
        assert left_of(*parts, ((0.0, 0.005, 0), (1.0, 0.005, 0)))[1].tolist() == [0, 1]

    def test_a_distance_of_zero_keeps_everything(self):
        assert len(left_of(self.STRONG, self.STRONG, overlap_distance_m=0.0)[0]) == 2

    def test_nothing_stays_nothing(self):
        left, source = left_of()
        assert left.shape == (0, 2, 3)
        assert len(source) == 0

    def test_the_map_lists_the_strongest_first(self):
        exact = world()
        tracks = LineTracks.from_lists([exact.tracks[0][:8], exact.tracks[0]])
        lines = exact.lines.take(np.array([0, 0]))
        config = dataclasses.replace(OPEN, overlap_distance_m=0.01)
        line_map, _ = trimmed(exact, config, tracks, lines)
        np.testing.assert_array_equal(line_map.observation_count, [24])
        both, _ = trimmed(exact, OPEN, tracks, lines)
        np.testing.assert_array_equal(both.observation_count, [24, 8])


class TestCoveredSpans:
    def test_spans_of_exact_lines_are_their_segments(self):
        exact = world()
        spans_m = covered_spans(exact.lines, exact.tracks, exact.views)
        ends = plucker.endpoints_from_plucker(exact.lines.direction, exact.lines.moment, spans_m)
        np.testing.assert_allclose(ends, exact.segments, rtol=0, atol=1e-12)

    def test_lines_without_observations_have_none(self):
        exact = world()
        tracks = LineTracks.from_lists([np.empty(0, np.int32), exact.tracks[1]])
        spans_m = covered_spans(exact.lines.take(np.array([0, 1])), tracks, exact.views)
        assert np.isnan(spans_m[0]).all()
        assert np.isfinite(spans_m[1]).all()
