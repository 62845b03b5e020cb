import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from roel_service.config.stages import PlaneFitConfig
from roel_service.geometry import segments
from roel_service.mapping.detect import Seeds
from roel_service.mapping.plane_fit import fit_space_time_planes, observations_of_frames

from .synthetic import event_frame_of, moving_line_events

# The vote as by default, and the paper's fit; both see the same events.
VOTE = PlaneFitConfig(method="vote")
RANSAC = PlaneFitConfig(
    method="ransac", candidate_distance_px=10.0, inlier_distance_px=2.0, trial_count=200
)
DIRECT = dataclasses.replace(RANSAC, method="direct", trial_count=20, cluster_distance_px=5.0)
METHODS = pytest.mark.parametrize("config", [VOTE, RANSAC], ids=["vote", "ransac"])

SEGMENT_PX = np.array([[40.0, 30.0], [110.0, 70.0]])
SPEED_PX_PER_MS = 0.05
# Positions are float32: 4e-6 px of rounding near 100 px, averaged over hundreds of events; the
# speed rests on times of some ms and is as exact.
EXACT_PX = 1e-5


def seeds_at(*lines, polarity=None):
    lines = np.array(lines, float).reshape(-1, 2, 2)
    polarity = np.zeros(len(lines)) if polarity is None else np.array(polarity)
    return Seeds(segments_px=lines, polarity=polarity.astype(np.int8))


def beside(segment_px, offset_px, turn_px=0.0):
    """The segment moved along its left normal, a little more at one end."""
    normal = segments.left_normal(segment_px)
    return segment_px + np.array([[offset_px - turn_px], [offset_px + turn_px]]) * normal


def below(distance_px):
    """The segment moved down the image."""
    return SEGMENT_PX + np.array([0.0, distance_px])


def fit(seeds, frame, config, seed=0):
    return fit_space_time_planes(seeds, frame, config, np.random.default_rng(seed))


def offsets_px(line_px, truth_px):
    """Largest distance of the ends of a fitted line from the true line."""
    return np.abs(segments.point_line_offset(line_px, truth_px)).max()


def signed_speed(fitted, index=0, truth_px=SEGMENT_PX):
    """Speed along the true line's left normal: fits may be directed either way."""
    same = np.dot(segments.left_normal(fitted.segments_px[index]), segments.left_normal(truth_px))
    return np.sign(same) * fitted.normal_speed_px_per_ms[index]


class TestExactPlane:
    @METHODS
    @pytest.mark.parametrize("speed", [-0.06, 0.0, 0.013, SPEED_PX_PER_MS])
    @pytest.mark.parametrize("flipped", [False, True])
    def test_line_and_speed_are_recovered(self, config, speed, flipped):
        frame = event_frame_of(moving_line_events(SEGMENT_PX, speed))
        seed = beside(SEGMENT_PX, 1.5, turn_px=0.5)
        fitted = fit(seeds_at(seed[::-1] if flipped else seed), frame, config)
        assert len(fitted.segments_px) == 1
        assert offsets_px(fitted.segments_px[0], SEGMENT_PX) < EXACT_PX
        assert signed_speed(fitted) == pytest.approx(speed, abs=1e-6)  # px/ms: EXACT_PX / 10 ms

    @settings(max_examples=30, deadline=None)
    @given(
        st.floats(0.0, 2 * np.pi),
        st.floats(-0.085, 0.085),
        st.floats(-1.5, 1.5),
        st.integers(0, 1_000),
    )
    @pytest.mark.parametrize("config", [VOTE, RANSAC], ids=["vote", "ransac"])
    def test_any_direction_and_speed_is_recovered(self, config, angle, speed, offset, draw):
        along = np.array([np.cos(angle), np.sin(angle)])
        truth = np.array([80.0, 60.0]) + np.array([[-25.0], [25.0]]) * along
        frame = event_frame_of(moving_line_events(truth, speed, seed=draw))
        fitted = fit(seeds_at(beside(truth, offset)), frame, config)
        assert len(fitted.segments_px) == 1
        assert offsets_px(fitted.segments_px[0], truth) < EXACT_PX
        assert signed_speed(fitted, truth_px=truth) == pytest.approx(speed, abs=1e-6)

    def test_vote_finds_the_ends_of_the_support(self):
        frame = event_frame_of(moving_line_events(SEGMENT_PX, SPEED_PX_PER_MS, count=800))
        seed = SEGMENT_PX[0] + np.array([[0.25], [0.75]]) * (SEGMENT_PX[1] - SEGMENT_PX[0])
        fitted = fit(seeds_at(seed), frame, VOTE)
        ends = np.sort(segments.position_along(fitted.segments_px[0], SEGMENT_PX[None]))
        # 80 px long; ends fall on the borders of bins, a bin beyond the last event at most.
        tolerance = VOTE.support_bin_px / segments.length(SEGMENT_PX)
        np.testing.assert_allclose(ends, [0, 1], rtol=0, atol=tolerance)

    def test_extension_limits_how_far_the_line_grows(self):
        frame = event_frame_of(moving_line_events(SEGMENT_PX, SPEED_PX_PER_MS, count=800))
        seed = SEGMENT_PX[0] + np.array([[0.4], [0.6]]) * (SEGMENT_PX[1] - SEGMENT_PX[0])
        config = dataclasses.replace(VOTE, extension_px=6.0)
        fitted = fit(seeds_at(seed), frame, config)
        # 6 px at either end, rounded up to whole bins.
        grown = segments.length(fitted.segments_px)[0] - segments.length(seed)
        assert 6 < grown <= 2 * 6 + VOTE.support_bin_px

    def test_ransac_projects_the_ends_of_the_seed(self):
        frame = event_frame_of(moving_line_events(SEGMENT_PX, SPEED_PX_PER_MS))
        seed = SEGMENT_PX[0] + np.array([[0.3], [0.6]]) * (SEGMENT_PX[1] - SEGMENT_PX[0])
        fitted = fit(seeds_at(beside(seed, 1.0)), frame, RANSAC)
        np.testing.assert_allclose(fitted.segments_px[0], seed, rtol=0, atol=EXACT_PX)

    def test_a_gap_ends_the_line_unless_it_may_be_bridged(self):
        first, last = SEGMENT_PX[0], SEGMENT_PX[1]
        step = last - first
        parts = [
            moving_line_events([first, first + 0.4 * step], 0.02, seed=1),
            moving_line_events([first + 0.6 * step, last], 0.02, seed=2),
        ]
        frame = event_frame_of(*parts)
        seed = np.array([first, first + 0.4 * step])
        # The gap is 16 px: five to six bins of 3 px.
        lengths = [
            segments.length(
                fit(
                    seeds_at(seed), frame, dataclasses.replace(VOTE, max_gap_bin_count=bins)
                ).segments_px
            )[0]
            for bins in (3, 7)
        ]
        whole = segments.length(SEGMENT_PX)
        assert lengths[0] == pytest.approx(0.4 * whole, abs=2 * 3.0)
        assert lengths[1] > 0.4 * whole + 16


class TestNoise:
    @METHODS
    def test_error_stays_within_that_of_the_mean(self, config):
        noise_px, count = 0.3, 400
        errors = []
        for draw in range(10):
            events = moving_line_events(
                SEGMENT_PX, SPEED_PX_PER_MS, count=count, noise_px=noise_px, seed=draw
            )
            fitted = fit(seeds_at(beside(SEGMENT_PX, 0.8)), event_frame_of(events), config)
            errors.append(offsets_px(fitted.segments_px[0], SEGMENT_PX))
        # An end of a fitted line deviates by 2 sigma / sqrt(n); the worse of two, in ten draws,
        # by some three of these deviations.
        assert max(errors) < 3 * 2 * noise_px / np.sqrt(count)

    @METHODS
    def test_events_all_over_the_image_do_not_matter_much(self, config):
        rng = np.random.default_rng(3)
        count = 600
        clutter = (
            rng.uniform(0, 119, (count, 2)),
            rng.integers(-10_000, 10_001, count),
            rng.choice([-1, 1], count),
        )
        frame = event_frame_of(moving_line_events(SEGMENT_PX, SPEED_PX_PER_MS), clutter)
        fitted = fit(seeds_at(beside(SEGMENT_PX, 1.0)), frame, config)
        # Some 20 of 600 fall within the inlier distance, 0.5 to 1 px off, among 400 exact ones.
        assert offsets_px(fitted.segments_px[0], SEGMENT_PX) < 0.1


class TestPolarity:
    NEGATIVE_PX = SEGMENT_PX
    POSITIVE_PX = beside(SEGMENT_PX, 2.0)

    def frame(self):
        return event_frame_of(
            moving_line_events(self.NEGATIVE_PX, 0.03, polarity=-1, seed=1),
            moving_line_events(self.POSITIVE_PX, 0.05, polarity=1, seed=2),
        )

    def test_vote_never_mixes_polarities(self):
        fitted = fit(seeds_at(beside(SEGMENT_PX, 1.0)), self.frame(), VOTE)
        order = np.argsort(fitted.polarity)
        np.testing.assert_array_equal(fitted.polarity[order], [-1, 1])
        for index, truth, speed in zip(
            order, (self.NEGATIVE_PX, self.POSITIVE_PX), (0.03, 0.05), strict=True
        ):
            assert offsets_px(fitted.segments_px[index], truth) < EXACT_PX
            assert signed_speed(fitted, index) == pytest.approx(speed, abs=1e-6)

    @pytest.mark.parametrize("label", [-1, 1])
    def test_a_seed_of_known_polarity_is_fitted_to_its_events_alone(self, label):
        fitted = fit(seeds_at(beside(SEGMENT_PX, 1.0), polarity=[label]), self.frame(), VOTE)
        np.testing.assert_array_equal(fitted.polarity, [label])

    def test_supporting_events_have_the_polarity_of_their_line(self):
        frame = self.frame()
        fitted = fit(seeds_at(beside(SEGMENT_PX, 1.0)), frame, VOTE)
        polarity_at = {
            (xy.tobytes(), t): p
            for xy, t, p in zip(
                frame.ideal_px, frame.events.t_us, frame.events.polarity, strict=True
            )
        }
        for line, label in enumerate(fitted.polarity):
            rows = slice(fitted.event_offsets[line], fitted.event_offsets[line + 1])
            events = zip(fitted.event_xy_px[rows], fitted.event_dt_us[rows], strict=True)
            assert {polarity_at[xy.tobytes(), int(dt)] for xy, dt in events} == {label}

    def test_ransac_takes_events_of_both_polarities(self):
        events = moving_line_events(SEGMENT_PX, SPEED_PX_PER_MS)
        mixed = (events[0], events[1], np.resize([-1, 1], len(events[1])))
        fitted = fit(seeds_at(beside(SEGMENT_PX, 1.0)), event_frame_of(mixed), RANSAC)
        np.testing.assert_array_equal(fitted.polarity, [0])
        assert offsets_px(fitted.segments_px[0], SEGMENT_PX) < EXACT_PX


class TestDuplicates:
    @METHODS
    def test_seeds_of_one_line_give_one_line(self, config):
        frame = event_frame_of(moving_line_events(SEGMENT_PX, SPEED_PX_PER_MS))
        seeds = seeds_at(*[beside(SEGMENT_PX, offset) for offset in (-1.4, 0.0, 1.4)])
        assert len(fit(seeds, frame, config).segments_px) == 1

    @METHODS
    def test_distant_lines_are_all_kept_in_the_order_of_their_evidence(self, config):
        others = [below(shift) for shift in (-20.0, 25.0)]
        frame = event_frame_of(
            *[
                moving_line_events(line, 0.02, count=count, seed=count)
                for line, count in zip((SEGMENT_PX, *others), (300, 500, 400), strict=True)
            ]
        )
        fitted = fit(seeds_at(SEGMENT_PX, *others), frame, config)
        assert len(fitted.segments_px) == 3
        for line, truth in zip(fitted.segments_px, (*others, SEGMENT_PX), strict=True):
            assert offsets_px(line, truth) < EXACT_PX

    def test_duplicate_rules_are_configured(self):
        frame = event_frame_of(
            moving_line_events(SEGMENT_PX, 0.0, seed=1),
            moving_line_events(beside(SEGMENT_PX, 4.0), 0.0, seed=2),
        )
        seeds = seeds_at(SEGMENT_PX, beside(SEGMENT_PX, 4.0))
        config = dataclasses.replace(
            VOTE, candidate_distance_px=1.5, min_density_ratio=0.0, duplicate_distance_px=6.0
        )
        assert len(fit(seeds, frame, config).segments_px) == 1
        config = dataclasses.replace(config, duplicate_distance_px=1.0)
        assert len(fit(seeds, frame, config).segments_px) == 2


class TestRefusal:
    def edge_and(self, *parts):
        return event_frame_of(moving_line_events(SEGMENT_PX, 0.02, count=200), *parts)

    def band(self, count):
        """Events in a band of 12 px about the segment, equally dense."""
        rng = np.random.default_rng(0)
        xy = beside(SEGMENT_PX, 0.0)[0] + rng.random((count, 1)) * (SEGMENT_PX[1] - SEGMENT_PX[0])
        xy = xy + rng.uniform(-6, 6, (count, 1)) * segments.left_normal(SEGMENT_PX)
        return xy, rng.integers(-10_000, 10_001, count), np.ones(count)

    def test_a_line_must_stand_out_from_its_surroundings(self):
        # 200 events on the line are 1.2 an px^2 within 1 px; 4000 in the band are 4.
        frame = self.edge_and(self.band(4_000))
        assert len(fit(seeds_at(SEGMENT_PX), frame, VOTE).segments_px) == 0
        lenient = dataclasses.replace(VOTE, min_density_ratio=0.5)
        assert len(fit(seeds_at(SEGMENT_PX), frame, lenient).segments_px) == 1

    def test_a_line_must_be_covered_along_most_of_its_length(self):
        # Every third bin of 3 px holds events; gaps of two bins are bridged.
        direction = (SEGMENT_PX[1] - SEGMENT_PX[0]) / segments.length(SEGMENT_PX)
        dashes = [
            moving_line_events(
                SEGMENT_PX[0] + np.array([[start], [start + 2.0]]) * direction, 0.0, 30, seed=start
            )
            for start in range(0, 80, 9)
        ]
        frame = event_frame_of(*dashes)
        assert len(fit(seeds_at(SEGMENT_PX), frame, VOTE).segments_px) == 0
        lenient = dataclasses.replace(VOTE, min_occupancy=0.2)
        assert len(fit(seeds_at(SEGMENT_PX), frame, lenient).segments_px) == 1

    def test_a_line_faster_than_the_vote_is_refused(self):
        # The vote ends at 0.09 px/ms for 160 px; the fit may reach twice that.
        frame = event_frame_of(moving_line_events(SEGMENT_PX, 0.3))
        found = fit(seeds_at(SEGMENT_PX), frame, VOTE).normal_speed_px_per_ms
        assert (np.abs(found) < 0.2).all()
        wide = dataclasses.replace(VOTE, max_speed_widths_per_s=2.5)
        assert signed_speed(fit(seeds_at(SEGMENT_PX), frame, wide)) == pytest.approx(0.3, abs=1e-5)

    def test_a_fine_vote_tells_parallel_lines_apart(self):
        frame = event_frame_of(
            *[
                moving_line_events(
                    beside(SEGMENT_PX, offset), 0.13, half_window_ms=25.0, seed=offset + 8
                )
                for offset in (-8, -4, 0, 4, 8)
            ]
        )
        fine = dataclasses.replace(VOTE, max_speed_widths_per_s=2.5, candidate_distance_px=8.0)
        fitted = fit(seeds_at(SEGMENT_PX), frame, fine)
        assert signed_speed(fitted) == pytest.approx(0.13, abs=1e-5)
        assert offsets_px(fitted.segments_px[0], SEGMENT_PX) < EXACT_PX
        # Two steps, -0.4 and 0.4 px/ms, see no difference between the line and its neighbours.
        coarse = dataclasses.replace(fine, speed_count=2, min_density_ratio=0.0)
        assert abs(signed_speed(fit(seeds_at(SEGMENT_PX), frame, coarse))) > 0.2

    def test_events_far_from_the_seed_are_no_candidates(self):
        frame = event_frame_of(moving_line_events(beside(SEGMENT_PX, 7.0), 0.0))
        assert len(fit(seeds_at(SEGMENT_PX), frame, VOTE).segments_px) == 0
        # The paper looks 10 px far.
        assert len(fit(seeds_at(SEGMENT_PX), frame, RANSAC).segments_px) == 1

    def test_ransac_needs_its_number_of_inliers(self):
        frame = event_frame_of(moving_line_events(SEGMENT_PX, 0.0, count=30))
        enough = dataclasses.replace(RANSAC, min_inlier_count=30)
        assert len(fit(seeds_at(SEGMENT_PX), frame, enough).segments_px) == 1
        more = dataclasses.replace(RANSAC, min_inlier_count=31)
        assert len(fit(seeds_at(SEGMENT_PX), frame, more).segments_px) == 0

    def test_ransac_refuses_a_plane_across_the_seed(self):
        across = np.array([[76.0, 40.0], [74.0, 60.0]])
        frame = event_frame_of(moving_line_events(across, 0.0))
        assert len(fit(seeds_at([[40, 50], [110, 50]]), frame, RANSAC).segments_px) == 0

    def test_time_scale_sets_what_a_distance_means_for_a_fast_line(self):
        # Its distance is |r| / sqrt(1 + (speed / scale)^2): at 1 px/ms and a scale of 0.2 px/ms an
        # event 10 px off at its own time counts as 2 px from the plane.
        frame = event_frame_of(
            moving_line_events(SEGMENT_PX, 1.0, half_window_ms=4.0, noise_px=2.0, count=400)
        )
        nearly_all = dataclasses.replace(RANSAC, min_inlier_count=380, time_scale_px_per_ms=0.2)
        assert len(fit(seeds_at(SEGMENT_PX), frame, nearly_all).segments_px) == 1
        published = dataclasses.replace(nearly_all, time_scale_px_per_ms=20.0)
        assert len(fit(seeds_at(SEGMENT_PX), frame, published).segments_px) == 0


DEGENERATE = {
    "no event": event_frame_of(([], np.empty(0), np.empty(0))),
    "one event": event_frame_of(([(75.0, 50.0)], np.zeros(1), np.ones(1))),
    "one pixel": event_frame_of((np.full((500, 2), 75.0), np.arange(500), np.ones(500))),
    "one event outside": event_frame_of(([(np.nan, np.nan)], np.zeros(1), np.ones(1))),
    "pairs at the ends": event_frame_of(
        (np.repeat(SEGMENT_PX, 2, axis=0), np.arange(4), np.ones(4))
    ),
}


class TestDegenerate:
    @METHODS
    @pytest.mark.parametrize("name", ["no event", "one event", "one event outside"])
    def test_without_events_there_is_no_line(self, config, name):
        fitted = fit(seeds_at(SEGMENT_PX), DEGENERATE[name], config)
        assert fitted.segments_px.shape == (0, 2, 2)
        assert fitted.event_offsets.tolist() == [0]
        assert len(fitted.event_xy_px) == len(fitted.event_dt_us) == 0

    @pytest.mark.parametrize("name", ["one pixel", "pairs at the ends"])
    def test_vote_refuses_events_that_are_no_line(self, name):
        assert len(fit(seeds_at(SEGMENT_PX), DEGENERATE[name], VOTE).segments_px) == 0

    def test_ransac_refuses_events_of_one_pixel_at_one_time(self):
        frame = event_frame_of((np.full((50, 2), 75.0), np.zeros(50), np.ones(50)))
        assert len(fit(seeds_at(SEGMENT_PX), frame, RANSAC).segments_px) == 0

    def test_events_of_one_pixel_over_time_give_a_finite_line_at_most(self):
        fitted = fit(seeds_at([[40.0, 75.0], [110.0, 75.0]]), DEGENERATE["one pixel"], RANSAC)
        assert np.isfinite(fitted.segments_px).all()
        assert np.isfinite(fitted.normal_speed_px_per_ms).all()

    def test_vote_fits_events_of_one_time_with_any_speed_in_range(self):
        xy_px, _, polarity = moving_line_events(SEGMENT_PX, 0.0)
        frame = event_frame_of((xy_px, np.zeros(len(xy_px)), polarity))
        fitted = fit(seeds_at(beside(SEGMENT_PX, 1.0)), frame, VOTE)
        assert len(fitted.segments_px) == 1
        assert offsets_px(fitted.segments_px[0], SEGMENT_PX) < EXACT_PX
        assert np.abs(fitted.normal_speed_px_per_ms).max() <= 0.09 + 1e-12

    def test_ransac_refuses_the_plane_of_one_time(self):
        # Off the line by noise, so that the instant is the plane that fits them best.
        xy_px, _, polarity = moving_line_events(SEGMENT_PX, 0.0, noise_px=0.3)
        frame = event_frame_of((xy_px, np.zeros(len(xy_px)), polarity))
        assert len(fit(seeds_at(beside(SEGMENT_PX, 1.0)), frame, RANSAC).segments_px) == 0

    @METHODS
    def test_no_seed_gives_no_line(self, config):
        frame = event_frame_of(moving_line_events(SEGMENT_PX, 0.0))
        assert len(fit(seeds_at(), frame, config).segments_px) == 0

    @METHODS
    def test_a_seed_beyond_the_image_is_harmless(self, config):
        frame = event_frame_of(moving_line_events(SEGMENT_PX, 0.0))
        assert len(fit(seeds_at([[500, 500], [600, 700]]), frame, config).segments_px) == 0


class TestSupport:
    def fitted(self, **changes):
        frame = event_frame_of(moving_line_events(SEGMENT_PX, SPEED_PX_PER_MS, count=400))
        config = dataclasses.replace(VOTE, **changes)
        return frame, fit(seeds_at(SEGMENT_PX), frame, config)

    def test_events_are_the_nearest_in_time_and_in_that_order(self):
        frame, fitted = self.fitted(support_event_count=50)
        dt_us = np.abs(fitted.event_dt_us)
        assert (np.diff(dt_us) >= 0).all()
        expected = np.sort(np.abs(frame.events.t_us - frame.events.t_ref_us))[:50]
        np.testing.assert_array_equal(dt_us, expected)

    def test_events_are_no_farther_in_time_than_allowed(self):
        _, fitted = self.fitted(support_half_window_us=3_000)
        assert 0 < np.abs(fitted.event_dt_us).max() < 3_000

    def test_events_lie_on_the_moving_line(self):
        _, fitted = self.fitted()
        assert len(fitted.event_dt_us) > 300
        shift = fitted.normal_speed_px_per_ms[0] * fitted.event_dt_us * 1e-3
        offset = segments.point_line_offset(fitted.event_xy_px, fitted.segments_px[0])
        np.testing.assert_allclose(offset, shift, rtol=0, atol=EXACT_PX * 2)

    def test_inlier_distance_bounds_them(self):
        events = moving_line_events(SEGMENT_PX, 0.0, count=600, noise_px=0.4)
        frame = event_frame_of(events)
        config = dataclasses.replace(VOTE, inlier_distance_px=0.5, support_event_count=1_000)
        fitted = fit(seeds_at(SEGMENT_PX), frame, config)
        shift = fitted.normal_speed_px_per_ms[0] * fitted.event_dt_us * 1e-3
        offset = segments.point_line_offset(fitted.event_xy_px, fitted.segments_px[0])
        assert np.abs(offset - shift).max() < 0.5 + EXACT_PX
        assert len(offset) < 600

    def test_events_are_kept_at_their_own_time_not_compensated(self):
        frame, _ = self.fitted()
        moved = dataclasses.replace(frame, ideal_px=frame.ideal_px + np.float32(7.0))
        fitted = fit(seeds_at(SEGMENT_PX), moved, VOTE)
        offset = segments.point_line_offset(fitted.event_xy_px - 7.0, fitted.segments_px[0])
        assert np.abs(offset).max() < 1.0
        assert offsets_px(fitted.segments_px[0], SEGMENT_PX) < EXACT_PX

    def test_time_is_counted_from_the_frame(self):
        events = moving_line_events(SEGMENT_PX, SPEED_PX_PER_MS)
        fits = [
            fit(seeds_at(SEGMENT_PX), event_frame_of(events, t_ref_us=t_ref_us), VOTE)
            for t_ref_us in (0, 10**15)
        ]
        np.testing.assert_array_equal(fits[0].event_dt_us, fits[1].event_dt_us)
        np.testing.assert_array_equal(fits[0].segments_px, fits[1].segments_px)


class TestReproducible:
    def frame(self):
        return event_frame_of(
            moving_line_events(SEGMENT_PX, 0.02, noise_px=0.5),
            moving_line_events(below(6), -0.02, noise_px=0.5, seed=5),
        )

    @METHODS
    def test_equal_seeds_give_equal_lines(self, config):
        seeds = seeds_at(SEGMENT_PX, below(6))
        first, second = (fit(seeds, self.frame(), config, seed=3) for _ in range(2))
        for name, value in vars(first).items():
            np.testing.assert_array_equal(value, getattr(second, name))

    def test_vote_does_not_draw(self):
        seeds = seeds_at(SEGMENT_PX)
        first, second = (fit(seeds, self.frame(), VOTE, seed=draw) for draw in (1, 2))
        np.testing.assert_array_equal(first.segments_px, second.segments_px)

    def test_ransac_with_few_trials_depends_on_the_draw(self):
        config = dataclasses.replace(RANSAC, trial_count=1)
        seeds = seeds_at(SEGMENT_PX)
        found = [fit(seeds, self.frame(), config, seed=draw).segments_px for draw in range(4)]
        assert any(not np.array_equal(found[0], other) for other in found[1:])


class TestObservationsOfFrames:
    def test_frames_are_joined_in_their_order(self):
        frames = [
            event_frame_of(moving_line_events(below(3 * index), 0.02, seed=index))
            for index in range(3)
        ]
        fits = [fit(seeds_at(below(3 * index)), frame, VOTE) for index, frame in enumerate(frames)]
        fits.insert(1, fit(seeds_at(), frames[0], VOTE))
        joined = observations_of_frames(fits)
        np.testing.assert_array_equal(joined.frame, [0, 2, 3])
        for row, part in zip(range(3), (fits[0], fits[2], fits[3]), strict=True):
            events = slice(joined.event_offsets[row], joined.event_offsets[row + 1])
            np.testing.assert_array_equal(joined.segments_px[row], part.segments_px[0])
            np.testing.assert_array_equal(joined.event_dt_us[events], part.event_dt_us)
            np.testing.assert_array_equal(joined.event_xy_px[events], part.event_xy_px)

    @pytest.mark.parametrize("frame_count", [0, 1, 3])
    def test_frames_without_lines_have_no_observations(self, frame_count):
        empty = fit(seeds_at(), DEGENERATE["no event"], VOTE)
        assert len(observations_of_frames([empty] * frame_count)) == 0


def rectangle(speed, count=400):
    """Four edges, each moving along its own normal, that meet in corners; and the edges."""
    corners = np.array([[40.0, 30.0], [120.0, 30.0], [120.0, 90.0], [40.0, 90.0]])
    edges = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
    parts = [moving_line_events(edge, speed, count=count, seed=i) for i, edge in enumerate(edges)]
    return parts, edges


class TestDirect:
    @pytest.mark.parametrize("speed", [-0.06, 0.0, 0.013, 0.3])
    def test_line_and_speed_are_recovered_without_a_seed(self, speed):
        frame = event_frame_of(moving_line_events(SEGMENT_PX, speed))
        fitted = fit(seeds_at(), frame, DIRECT)
        assert len(fitted.segments_px) == 1
        assert offsets_px(fitted.segments_px[0], SEGMENT_PX) < EXACT_PX
        assert signed_speed(fitted) == pytest.approx(speed, abs=1e-6)

    def test_ends_follow_from_the_spread_of_the_events(self):
        frame = event_frame_of(moving_line_events(SEGMENT_PX, SPEED_PX_PER_MS, count=2_000))
        fitted = fit(seeds_at(), frame, DIRECT)
        ends = np.sort(segments.position_along(fitted.segments_px[0], SEGMENT_PX[None]))
        # The deviation of 2000 uniform draws is known to 1 / sqrt(2000) / sqrt(5) = 1 % of itself,
        # their mean to 0.6 % of the length.
        np.testing.assert_allclose(ends, [0, 1], rtol=0, atol=0.03)

    def test_seeds_are_not_used(self):
        frame = event_frame_of(moving_line_events(SEGMENT_PX, SPEED_PX_PER_MS))
        with_seeds, without = (
            fit(seeds, frame, DIRECT) for seeds in (seeds_at(below(40), SEGMENT_PX), seeds_at())
        )
        np.testing.assert_array_equal(with_seeds.segments_px, without.segments_px)

    def test_lines_apart_are_clusters_of_their_own(self):
        lines = [SEGMENT_PX, below(30), below(-20)]
        parts = [moving_line_events(line, 0.02, seed=i) for i, line in enumerate(lines)]
        fitted = fit(seeds_at(), event_frame_of(*parts), DIRECT)
        assert len(fitted.segments_px) == 3
        for line in lines:
            nearest = min(offsets_px(found, line) for found in fitted.segments_px)
            assert nearest < EXACT_PX

    def test_edges_that_meet_are_one_cluster_of_which_one_edge_is_found(self):
        """Why the paper lets detected lines guide the fit."""
        parts, edges = rectangle(0.0)
        fitted = fit(seeds_at(), event_frame_of(*parts), DIRECT)
        assert len(fitted.segments_px) == 1
        assert min(offsets_px(fitted.segments_px[0], edge) for edge in edges) < 1.0
        guided = fit(seeds_at(*edges), event_frame_of(*parts), RANSAC)
        assert len(guided.segments_px) == 4

    @pytest.mark.parametrize(
        "changes",
        [{"cluster_distance_px": 0.2}, {"cluster_min_event_count": 100}, {"min_inlier_count": 500}],
    )
    def test_clusters_are_configured(self, changes):
        frame = event_frame_of(moving_line_events(SEGMENT_PX, SPEED_PX_PER_MS))
        config = dataclasses.replace(DIRECT, **changes)
        assert len(fit(seeds_at(), frame, config).segments_px) == 0

    def test_a_long_millisecond_tears_a_line_to_pieces(self):
        frame = event_frame_of(moving_line_events(SEGMENT_PX, SPEED_PX_PER_MS))
        config = dataclasses.replace(DIRECT, cluster_time_scale_px_per_ms=50.0)
        assert len(fit(seeds_at(), frame, config).segments_px) == 0

    def test_events_of_one_time_are_no_moving_line(self):
        xy_px, _, polarity = moving_line_events(SEGMENT_PX, 0.0, noise_px=0.3)
        frame = event_frame_of((xy_px, np.zeros(len(xy_px)), polarity))
        assert len(fit(seeds_at(), frame, DIRECT).segments_px) == 0

    @pytest.mark.parametrize("place", [np.nan, 50.0])
    def test_without_a_cluster_there_is_no_line(self, place):
        frame = event_frame_of((np.full((1, 2), place), np.zeros(1), np.ones(1)))
        assert len(fit(seeds_at(), frame, DIRECT).segments_px) == 0


class TestNone:
    def test_lines_stay_as_they_were_detected(self):
        frame = event_frame_of(moving_line_events(SEGMENT_PX, SPEED_PX_PER_MS))
        seeds = seeds_at(beside(SEGMENT_PX, 1.5), below(2.0), polarity=[1, 0])
        fitted = fit(seeds, frame, PlaneFitConfig(method="none"))
        np.testing.assert_array_equal(fitted.segments_px, seeds.segments_px)
        np.testing.assert_array_equal(fitted.polarity, [1, 0])
        np.testing.assert_array_equal(fitted.normal_speed_px_per_ms, [0, 0])

    def test_no_event_supports_them(self):
        frame = event_frame_of(moving_line_events(SEGMENT_PX, SPEED_PX_PER_MS))
        fitted = fit(seeds_at(SEGMENT_PX, below(2.0)), frame, PlaneFitConfig(method="none"))
        np.testing.assert_array_equal(fitted.event_offsets, [0, 0, 0])
        assert fitted.event_xy_px.shape == (0, 2)
        assert len(observations_of_frames([fitted])) == 2
