import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from roel_service.config.stages import RefineConfig
from roel_service.geometry import plucker, projection, segments
from roel_service.geometry.se3 import rotation_from_vector, skew
from roel_service.mapping import refine
from roel_service.mapping.refine import (
    DirectionPrior,
    OrthonormalLines,
    _Problem,
    refine_lines,
)
from roel_service.scene.lines import InfiniteLines, LineTracks

from .synthetic import line_errors, perturbed, world

PIXEL = RefineConfig(residual="pixel", iteration_count=12)
# As published: squared, no gate, events weighted by 1e4.
GRASSMANN = RefineConfig(
    residual="grassmann",
    loss="squared",
    event_weight=1e4,
    event_count_per_line=50,
    max_residual_px=1e6,
    iteration_count=12,
)
# As in LIMAP: no events, weights in proportion to the length.
REPROJECTION = RefineConfig(
    residual="reprojection",
    loss="cauchy",
    loss_scale_px=1.0,
    loss_scale_medians=0.0,
    event_weight=0.0,
    max_length_weight_px=1e6,
    max_residual_px=20.0,
    iteration_count=12,
)
RESIDUALS = pytest.mark.parametrize(
    "config", [PIXEL, GRASSMANN, REPROJECTION], ids=["pixel", "grassmann", "reprojection"]
)
QUARTIC = [
    dataclasses.replace(config, loss="quartic") for config in (PIXEL, GRASSMANN, REPROJECTION)
]
# With events, and with every term squared once more.
COSTS = pytest.mark.parametrize(
    "config",
    [PIXEL, GRASSMANN, REPROJECTION, dataclasses.replace(REPROJECTION, event_weight=1.0), *QUARTIC],
)


def refined(world, lines=None, tracks=None, config=PIXEL):
    return refine_lines(
        world.lines if lines is None else lines,
        world.tracks if tracks is None else tracks,
        world.evidence(config),
        world.frames,
        config,
    )


def start_of(problem, lines):
    """The lines as the first step sees them."""
    moment = plucker.shift_origin(lines.direction, lines.moment, problem.origin)
    U, phi = plucker.orthonormal_from_plucker(lines.direction, moment)
    return OrthonormalLines(U=U, phi=phi)


class TestExact:
    @RESIDUALS
    @pytest.mark.parametrize("scale", [1.0, 100.0])
    @pytest.mark.parametrize("draw", [0, 1, 2])
    def test_lines_are_recovered_from_a_perturbed_start(self, config, scale, draw):
        exact = world(scale)
        # 1 px is 2 cm at 2.5 m and f 120 px; gates are at 2 px.
        start = perturbed(exact.lines, angle_rad=0.01, offset_m=0.01 * scale, seed=draw)
        assert line_errors(start, exact.segments)[:, 0].max() > 0.005 * scale
        found = refined(exact, start, config=config)
        assert not found.diverged.any()
        # The events' float32 pixels are rounded by 4e-6 px, 1e-7 m at this distance.
        assert line_errors(found.lines, exact.segments).max() < 1e-6 * scale
        assert found.rms_px.max() < 1e-5

    @RESIDUALS
    def test_lines_through_the_world_origin_are_recovered(self, config):
        exact = world(lines=(0,))
        assert np.linalg.norm(exact.lines.moment) < 1e-12
        found = refined(exact, perturbed(exact.lines, 0.01, 0.01), config=config)
        assert line_errors(found.lines, exact.segments).max() < 1e-6

    @pytest.mark.parametrize(
        "config",
        [
            dataclasses.replace(PIXEL, event_weight=0.0),
            dataclasses.replace(PIXEL, loss="squared"),
            dataclasses.replace(PIXEL, event_count_per_line=5),
            dataclasses.replace(GRASSMANN, event_weight=0.0),
        ],
        ids=["lines only", "squared", "few events", "published, lines only"],
    )
    def test_every_part_of_the_cost_vanishes_at_the_truth(self, config):
        exact = world()
        found = refined(exact, perturbed(exact.lines, 0.01, 0.01), config=config)
        assert line_errors(found.lines, exact.segments).max() < 1e-6

    @RESIDUALS
    def test_the_truth_stays_where_it_is(self, config):
        exact = world()
        found = refined(exact, config=dataclasses.replace(config, iteration_count=1))
        assert line_errors(found.lines, exact.segments).max() < 1e-6
        np.testing.assert_array_equal(found.tracks.observation, exact.tracks.observation)

    @RESIDUALS
    def test_lines_influence_each_other_by_the_scale_of_the_loss_alone(self, config):
        config = dataclasses.replace(config, loss_scale_medians=0.0)
        noisy = world(noise_px=0.2, event_noise_px=0.2)
        start = perturbed(noisy.lines, 0.005, 0.005)
        together = refined(noisy, start, config=config)
        some = np.array([7, 2])
        alone = refined(noisy, start.take(some), noisy.tracks.take(some), config)
        # Sums in another order; where the last step still lowers the cost is up to rounding.
        np.testing.assert_allclose(
            alone.lines.moment, together.lines.moment[some], rtol=0, atol=1e-7
        )


class TestGradient:
    """The gradient is that of half the cost, in the tangent of the orthonormal form."""

    @COSTS
    @settings(max_examples=10, deadline=None)
    @given(st.integers(0, 10_000), st.sampled_from([1.0, 100.0]))
    def test_it_agrees_with_central_differences_of_the_cost(self, config, draw, scale):
        noisy = world(scale, noise_px=0.5, event_noise_px=0.5)
        problem = _Problem(noisy.lines, noisy.tracks, noisy.evidence(config), noisy.frames, config)
        lines = perturbed(noisy.lines, 0.02, 0.02 * scale, seed=draw)
        moment = plucker.shift_origin(lines.direction, lines.moment, problem.origin)
        U, phi = plucker.orthonormal_from_plucker(lines.direction, moment)
        state = OrthonormalLines(U=U, phi=phi)
        # As within one step: the points at which lines are compared, and robust weights, are held.
        middles_m = problem._middles_m(state)
        problem._middles_m = lambda state: middles_m
        rng = np.random.default_rng(draw)
        weight = rng.uniform(0.1, 1.0, len(problem.line))

        def cost(delta):
            U_moved, phi_moved = plucker.retract_orthonormal(U, phi, np.tile(delta, (len(U), 1)))
            return problem.system(OrthonormalLines(U=U_moved, phi=phi_moved), weight).cost

        # The last number turns the distance: d|m| = |m|^2 d phi, so its step shrinks with scale.
        steps = np.array([1e-5, 1e-5, 1e-5, 1e-5 / scale])
        numeric = np.stack(
            [(cost(step) - cost(-step)) / (2 * step.sum()) for step in np.diag(steps)], axis=-1
        )
        gradient = 2.0 * problem.system(state, weight).gradient
        size = np.abs(gradient).max(axis=1, keepdims=True)
        # Central differences at 1e-5: truncation 1e-10 of the third derivative, which the quartic
        # cost of short lines has large, rounding 1e-11 of the cost; relative to the largest part.
        assert (np.abs(numeric - gradient) < 1e-4 * size).all()

    @RESIDUALS
    def test_the_hessian_is_the_derivative_of_the_gradient_at_the_truth(self, config):
        exact = world()
        problem = _Problem(exact.lines, exact.tracks, exact.evidence(config), exact.frames, config)
        moment = plucker.shift_origin(exact.lines.direction, exact.lines.moment, problem.origin)
        U, phi = plucker.orthonormal_from_plucker(exact.lines.direction, moment)
        weight = np.ones(len(problem.line))
        hessian = problem.system(OrthonormalLines(U=U, phi=phi), weight).hessian
        columns = []
        for step in 1e-6 * np.eye(4):
            ahead, back = (
                problem.system(
                    OrthonormalLines(
                        **dict(
                            zip(
                                ("U", "phi"),
                                plucker.retract_orthonormal(U, phi, np.tile(delta, (len(U), 1))),
                                strict=True,
                            )
                        )
                    ),
                    weight,
                ).gradient
                for delta in (step, -step)
            )
            columns.append((ahead - back) / 2e-6)
        numeric = np.stack(columns, axis=-1)
        size = np.abs(hessian).max(axis=(1, 2), keepdims=True)
        # Gauss-Newton is exact where residuals vanish.
        assert (np.abs(numeric - hessian) < 1e-5 * size).all()


class TestQuartic:
    """The other reading of the published cost: every squared residual is squared."""

    @pytest.mark.parametrize(
        ("config", "weight"),
        [
            (PIXEL, "form_weight"),
            (REPROJECTION, "weight"),
            (dataclasses.replace(GRASSMANN, event_weight=0.0), "weight"),
            # Without its lines.
            (dataclasses.replace(GRASSMANN, max_length_weight_px=1e-30), "form_weight"),
        ],
        ids=["pixel", "reprojection", "published lines", "published events"],
    )
    def test_it_is_the_square_of_each_term(self, config, weight):
        noisy = world(noise_px=0.5, event_noise_px=0.5)
        lines = noisy.lines.take(noisy.line_of)
        tracks = LineTracks.from_lists([[row] for row in range(len(lines))])
        costs = []
        for loss in ("squared", "quartic"):
            reading = dataclasses.replace(config, loss=loss)
            problem = _Problem(lines, tracks, noisy.evidence(config), noisy.frames, reading)
            costs.append(problem.cost(start_of(problem, lines), np.ones(len(lines))))
        np.testing.assert_allclose(getattr(problem, weight) * costs[1], costs[0] ** 2, rtol=1e-12)

    @pytest.mark.parametrize("config", QUARTIC, ids=["pixel", "grassmann", "reprojection"])
    def test_lines_come_closer_with_every_step(self, config):
        exact = world()
        start = perturbed(exact.lines, 0.01, 0.01)
        errors = [
            line_errors(
                refined(
                    exact, start, config=dataclasses.replace(config, iteration_count=count)
                ).lines,
                exact.segments,
            )[:, 0].max()
            for count in (1, 12, 40)
        ]
        # Newton's method on a fourth power takes a third of the way at each step.
        assert errors[1] < 0.1 * errors[0]
        assert errors[2] < 1e-3 * errors[0]

    def test_the_largest_residual_weighs_most(self):
        noisy = world(noise_px=0.3)
        largest = []
        for loss in ("squared", "quartic"):
            config = dataclasses.replace(
                REPROJECTION, loss=loss, max_length_weight_px=1.0, iteration_count=40
            )
            found = refined(noisy, config=config)
            problem = _Problem(
                found.lines, noisy.tracks, noisy.evidence(config), noisy.frames, config
            )
            ends = np.abs(problem._end_distances_px(start_of(problem, found.lines)))
            largest.append(np.maximum.reduceat(ends.max(axis=1), noisy.tracks.offsets[:-1]))
        assert (largest[1] < largest[0] + 1e-6).mean() > 0.9


class TestReprojection:
    """The lines are the true ones, so that distances follow from the true segments' images."""

    NOISY = world(noise_px=0.5)

    def problem(self):
        noisy = self.NOISY
        return _Problem(
            noisy.lines, noisy.tracks, noisy.evidence(REPROJECTION), noisy.frames, REPROJECTION
        )

    def squared_px(self):
        """(M,) squared distances of both ends together."""
        noisy = self.NOISY
        T_camera_world = noisy.frames.T_world_camera[noisy.observations.frame].inverse()
        in_camera = T_camera_world[:, None] @ noisy.segments[noisy.line_of]
        images = projection.project(in_camera, noisy.frames.K)
        ends = segments.point_line_offset(noisy.observations.segments_px, images[:, None])
        return np.sum(ends**2, axis=1)

    def test_cost_is_that_of_the_distances_in_the_image(self):
        problem, observations = self.problem(), self.NOISY.observations
        rows = segments.length(observations.segments_px) * self.squared_px()
        expected = np.bincount(self.NOISY.line_of, rows) / REPROJECTION.max_length_weight_px
        state = start_of(problem, self.NOISY.lines)
        np.testing.assert_allclose(problem.cost(state, np.ones(len(rows))), expected, rtol=1e-9)

    def test_its_loss_is_that_of_both_ends_together(self):
        problem = self.problem()
        state = start_of(problem, self.NOISY.lines)
        weight = problem.robust_weight(state, problem.residual_px(state))
        expected = 1 / (1 + self.squared_px()[problem.observation])
        np.testing.assert_allclose(weight, expected, rtol=1e-9)


class TestNoSteps:
    @pytest.mark.parametrize("config", [PIXEL, GRASSMANN, REPROJECTION, *QUARTIC])
    def test_lines_stay_as_they_were(self, config):
        exact = world()
        start = perturbed(exact.lines, 0.002, 0.002)
        found = refined(exact, start, config=dataclasses.replace(config, iteration_count=0))
        # To the orthonormal form about the line's own origin, and back.
        np.testing.assert_allclose(found.lines.direction, start.direction, rtol=0, atol=1e-12)
        np.testing.assert_allclose(found.lines.moment, start.moment, rtol=0, atol=1e-12)
        assert not found.diverged.any()


class TestNoise:
    @RESIDUALS
    def test_error_is_in_proportion_to_the_noise(self, config):
        errors = []
        for noise_px in (0.025, 0.05):
            noisy = world(noise_px=noise_px, event_noise_px=noise_px)
            found = refined(noisy, perturbed(noisy.lines, 0.005, 0.005), config=config)
            assert not found.diverged.any()
            errors.append(line_errors(found.lines, noisy.segments)[:, 0])
        errors = np.array(errors)
        # The same draw, scaled: errors double with the noise, but for robust weights and gates.
        np.testing.assert_allclose(errors[1], 2 * errors[0], rtol=0.2, atol=1e-4)
        # 0.05 px at f 120 px and 2.5 m over a base of 0.4 m is 6.5 mm for one pair of views.
        assert errors[1].max() < 0.0065

    def test_events_make_lines_better(self):
        noisy = world(noise_px=0.3, event_noise_px=0.3)
        with_events, without = (
            np.median(line_errors(refined(noisy, config=config).lines, noisy.segments)[:, 0])
            for config in (
                dataclasses.replace(PIXEL, event_weight=4.0),
                dataclasses.replace(PIXEL, event_weight=0.0),
            )
        )
        assert with_events < without

    def outlying(self):
        exact = world(frame_count=24)
        lines = exact.observations.segments_px.copy()
        wrong = np.arange(len(lines)) % 9 == 4
        lines[wrong] += 1.4
        observations = dataclasses.replace(exact.observations, segments_px=lines)
        return dataclasses.replace(exact, observations=observations), wrong

    def test_a_robust_loss_resists_outliers_inside_the_gate(self):
        spoilt, _ = self.outlying()
        config = dataclasses.replace(PIXEL, max_residual_px=10.0, event_weight=0.0)
        robust, squared = (
            line_errors(
                refined(spoilt, config=dataclasses.replace(config, loss=loss)).lines,
                spoilt.segments,
            )[:, 0].max()
            for loss in ("cauchy", "squared")
        )
        assert robust < 0.5 * squared
        sharper = dataclasses.replace(config, loss_scale_px=0.2)
        assert line_errors(refined(spoilt, config=sharper).lines, spoilt.segments)[:, 0].max() < (
            robust
        )

    def test_the_loss_widens_with_the_residuals_of_a_recording(self):
        fixed = dataclasses.replace(PIXEL, loss_scale_px=0.05, event_weight=0.0)
        sharp = dataclasses.replace(fixed, loss_scale_medians=3.0)
        wide = dataclasses.replace(fixed, loss_scale_px=1.0)

        noisy = world(noise_px=0.4)
        error = {
            name: np.linalg.norm(
                line_errors(refined(noisy, config=config).lines, noisy.segments)[:, 0]
            )
            for name, config in {"follows": sharp, "fixed": fixed, "wide": wide}.items()
        }
        # A loss far below the noise heeds few observations alone.
        assert error["follows"] < error["fixed"]
        assert error["follows"] == pytest.approx(error["wide"], rel=0.1)

    def test_the_loss_stays_as_sharp_as_configured_on_good_observations(self):
        spoilt, _ = self.outlying()
        # As good as off, and all lines at once all the same: parts of them are rounded in other ways.
        fixed = dataclasses.replace(
            PIXEL, loss_scale_px=0.35, event_weight=0.0, loss_scale_medians=1e-9
        )
        config = dataclasses.replace(fixed, loss_scale_medians=3.0)
        np.testing.assert_array_equal(
            refined(spoilt, config=config).lines.moment, refined(spoilt, config=fixed).lines.moment
        )

    def test_the_gate_removes_outliers_and_the_lines_are_exact_again(self):
        spoilt, wrong = self.outlying()
        config = dataclasses.replace(PIXEL, max_residual_px=0.6)
        found = refined(spoilt, config=config)
        kept = np.zeros(len(wrong), bool)
        kept[found.tracks.observation] = True
        assert kept[~wrong].all()
        # Those that were moved along their line are no outliers.
        assert kept[wrong].mean() < 0.3

    @pytest.mark.parametrize("iteration_count", [1, 2, 8])
    def test_the_gate_of_the_result_is_the_configured_one(self, iteration_count):
        exact = world()
        lines = exact.observations.segments_px.copy()
        # Between the gate of the first steps, 3 px, and that of the result, 2 px.
        lines[7] += 2.6 * segments.left_normal(lines[7])
        observations = dataclasses.replace(exact.observations, segments_px=lines)
        spoilt = dataclasses.replace(exact, observations=observations)
        config = dataclasses.replace(PIXEL, iteration_count=iteration_count, event_weight=0.0)
        found = refined(spoilt, config=config)
        assert 7 not in found.tracks.observation
        assert len(found.tracks.observation) == len(lines) - 1

    def test_long_observations_weigh_more_up_to_the_cap(self):
        noisy = world(noise_px=0.3)
        moments = [
            refined(noisy, config=dataclasses.replace(PIXEL, max_length_weight_px=cap)).lines.moment
            for cap in (1.0, 2.0, 60.0)
        ]
        # All are longer than 2 px: below that the cap is one weight for all, and no weight.
        np.testing.assert_allclose(moments[0], moments[1], rtol=0, atol=1e-9)
        assert np.abs(moments[0] - moments[2]).max() > 1e-5


class TestInformation:
    def test_it_predicts_the_spread_of_repeated_measurements(self):
        """Covariance is sigma^2 / information, for a deviation of sigma px an observation."""
        exact = world(lines=(9,))
        config = dataclasses.replace(
            PIXEL, loss="squared", event_weight=0.0, max_length_weight_px=1.0
        )
        rng = np.random.default_rng(0)
        sigma_px, moments = 0.05, []
        segments_px = exact.observations.segments_px
        left = segments.left_normal(segments_px)
        for _ in range(50):
            # Three rays at the middle and 0.39 lengths from it, a third of an observation each: the
            # shift deviates by sigma, the slope by sigma sqrt(3 / 2) / 0.39 L.
            shift, slope = sigma_px * rng.standard_normal((2, len(left), 1))
            turn = 0.5 * np.sqrt(1.5) / 0.39 * slope * np.array([-1.0, 1.0])
            offset_px = (shift + turn)[..., None] * left[:, None]
            observations = dataclasses.replace(
                exact.observations, segments_px=segments_px + offset_px
            )
            noisy = dataclasses.replace(exact, observations=observations)
            moments.append(refined(noisy, config=config).lines.moment[0])
        truth = refined(exact, config=config)
        direction, origin = truth.lines.direction, truth.origin
        U, phi = plucker.orthonormal_from_plucker(
            direction, plucker.shift_origin(direction, truth.lines.moment, origin)
        )
        by_direction, by_moment = plucker.plucker_jacobians(U, phi)
        # The moment about the world's origin is m + origin x v.
        by_tangent = (by_moment + skew(origin) @ by_direction)[0]
        covariance = sigma_px**2 * by_tangent @ np.linalg.inv(truth.information[0]) @ by_tangent.T
        ratio = np.var(moments, axis=0).sum() / np.trace(covariance)
        # 50 draws of some three independent numbers tell a variance to 15 %.
        assert ratio == pytest.approx(1.0, abs=0.3)

    def test_more_views_carry_more_information(self):
        sizes = []
        for frame_count in (12, 48):
            exact = world(frame_count=frame_count, lines=(1,))
            sizes.append(np.trace(refined(exact).information[0]))
        # Four times the views, of the same places.
        assert sizes[1] / sizes[0] == pytest.approx(4.0, rel=0.2)


class TestDegenerate:
    @RESIDUALS
    def test_no_lines_give_no_lines(self, config):
        exact = world()
        nothing = InfiniteLines(direction=np.empty((0, 3)), moment=np.empty((0, 3)))
        found = refined(exact, nothing, LineTracks.from_lists([]), config)
        assert len(found) == len(found.rms_px) == len(found.tracks) == 0
        assert len(found.take(np.zeros(0, bool))) == 0

    @RESIDUALS
    def test_a_line_without_observations_has_diverged_and_leaves_others_alone(self, config):
        exact = world()
        tracks = LineTracks.from_lists([exact.tracks[0], np.empty(0, np.int32), exact.tracks[2]])
        start = perturbed(exact.lines.take(np.array([0, 1, 2])), 0.01, 0.01)
        found = refined(exact, start, tracks, config)
        np.testing.assert_array_equal(found.diverged, [False, True, False])
        errors = line_errors(found.lines, exact.segments[:3])
        assert errors[[0, 2]].max() < 1e-6
        assert found.rms_px[1] == 0.0

    def test_a_line_with_too_few_inliers_has_diverged(self):
        exact = world()
        # Two right ones, and ten of other lines.
        mixed = np.concatenate([exact.tracks[0][:2], exact.tracks[7][:5], exact.tracks[4][:5]])
        tracks = LineTracks.from_lists([mixed])
        start = exact.lines.take(np.array([0]))
        found = refined(exact, start, tracks)
        np.testing.assert_array_equal(found.diverged, [True])
        fewer = dataclasses.replace(PIXEL, min_inlier_count=2)
        np.testing.assert_array_equal(refined(exact, start, tracks, fewer).diverged, [False])

    @RESIDUALS
    def test_a_start_far_from_the_truth_ends_finite(self, config):
        exact = world()
        found = refined(exact, perturbed(exact.lines, 1.0, 1.0), config=config)
        assert np.isfinite(found.lines.moment).all()
        assert np.isfinite(found.rms_px).all()

    @RESIDUALS
    def test_a_line_through_a_camera_centre_ends_finite(self, config):
        exact = world()
        track = exact.tracks[0]
        centre = exact.frames.T_world_camera.translation[exact.observations.frame[track[5]]]
        direction = np.array([[0.0, 0.0, 1.0]])
        start = InfiniteLines(
            direction=direction, moment=plucker.moment_from_point(centre, direction)
        )
        found = refined(exact, start, LineTracks.from_lists([track]), config)
        assert np.isfinite(found.lines.moment).all()
        # The gate leaves nothing of it; those of the others are wide.
        np.testing.assert_array_equal(found.diverged, [config is PIXEL])

    @RESIDUALS
    def test_an_observation_may_support_several_lines(self, config):
        exact = world()
        twice = LineTracks.from_lists([exact.tracks[3], exact.tracks[3]])
        start = perturbed(exact.lines.take(np.array([3, 3])), 0.01, 0.01)
        found = refined(exact, start, twice, config)
        assert line_errors(found.lines, exact.segments[[3, 3]]).max() < 1e-6

    def test_take_picks_the_same_lines_of_all(self):
        found = refined(world())
        some = found.take(np.array([4, 1]))
        np.testing.assert_array_equal(some.lines.moment, found.lines.moment[[4, 1]])
        np.testing.assert_array_equal(some.tracks[1], found.tracks[1])
        np.testing.assert_array_equal(some.information, found.information[[4, 1]])


@COSTS
def test_lines_that_rest_are_where_all_steps_bring_them(config, monkeypatch):
    noisy = world(noise_px=0.3, event_noise_px=0.3)
    config = dataclasses.replace(config, iteration_count=20)
    start = perturbed(noisy.lines, angle_rad=0.01, offset_m=0.01)
    resting = refined(noisy, start, config=config)
    monkeypatch.setattr(refine, "RESTING_SHARE", -1.0)
    moving = refined(noisy, start, config=config)
    off = line_errors(resting.lines, noisy.segments)
    assert np.median(off[:, 0]) > 1e-4
    np.testing.assert_allclose(off, line_errors(moving.lines, noisy.segments), rtol=0.02, atol=1e-6)


def test_a_direction_pulls_by_its_squared_sine():
    rng = np.random.default_rng(0)
    lines = world().lines
    moment = plucker.shift_origin(lines.direction, lines.moment, np.zeros((len(lines), 3)))
    U, phi = plucker.orthonormal_from_plucker(lines.direction, moment)
    direction = rotation_from_vector(0.1 * rng.normal(size=(len(lines), 3))) @ U[:, :, :1]
    prior = DirectionPrior(direction=direction[..., 0], weight=rng.uniform(1.0, 2.0, len(lines)))
    sine = np.linalg.norm(np.cross(lines.direction, prior.direction), axis=1)
    system = refine.direction_system(OrthonormalLines(U=U, phi=phi), prior)
    np.testing.assert_allclose(system.cost, prior.weight * sine**2)
    for k, step in enumerate(1e-6 * np.eye(4)):
        both = [
            refine.direction_cost(
                OrthonormalLines(U=ahead, phi=later),
                prior,
            )
            for ahead, later in (
                plucker.retract_orthonormal(U, phi, np.tile(sign * step, (len(lines), 1)))
                for sign in (1.0, -1.0)
            )
        ]
        # The gradients are halves, as everywhere.
        np.testing.assert_allclose(
            system.gradient[:, k], (both[0] - both[1]) / 4e-6, atol=1e-9, rtol=1e-6
        )
    np.testing.assert_array_equal(system.hessian, np.swapaxes(system.hessian, 1, 2))
    assert (np.linalg.eigvalsh(system.hessian) > -1e-12).all()


@pytest.mark.parametrize("config", [PIXEL, dataclasses.replace(PIXEL, loss_scale_medians=2.0)])
def test_lines_are_the_same_with_any_number_of_threads(config):
    exact = world()
    start = perturbed(exact.lines, angle_rad=0.01, offset_m=0.01)
    arguments = start, exact.tracks, exact.evidence(config), exact.frames, config
    alone, together = (refine_lines(*arguments, worker_count=count) for count in (1, 3))
    np.testing.assert_array_equal(alone.lines.moment, together.lines.moment)
    np.testing.assert_array_equal(alone.information, together.information)
    np.testing.assert_array_equal(alone.tracks.offsets, together.tracks.offsets)
    np.testing.assert_array_equal(alone.tracks.observation, together.tracks.observation)


def test_a_line_does_not_depend_on_the_others():
    exact = world()
    start = perturbed(exact.lines, angle_rad=0.01, offset_m=0.01)
    together = refined(exact, start)
    for line in range(len(start)):
        alone = refined(exact, start.take(slice(line, line + 1)), exact.tracks.take([line]))
        np.testing.assert_allclose(alone.lines.moment[0], together.lines.moment[line], atol=1e-12)
        np.testing.assert_array_equal(alone.tracks[0], together.tracks[line])
