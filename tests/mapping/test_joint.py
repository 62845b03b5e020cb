import dataclasses

import numpy as np
import pytest

from roel_service.config.stages import RefineConfig
from roel_service.evaluation.poses import rotation_errors_rad, translation_errors_m
from roel_service.geometry import plucker
from roel_service.geometry.alignment import align_points
from roel_service.geometry.se3 import SE3
from roel_service.mapping.front_end import Detected
from roel_service.mapping.joint import _believed, _Problem, _State, refine_jointly
from roel_service.mapping.pose_correction import Drift, PoseCorrection
from roel_service.mapping.refine import DirectionPrior, OrthonormalLines, refine_lines
from roel_service.mapping.views import end_residuals_px, views_of

from .synthetic import line_errors, observed, perturbed, trajectory, world

INTERVAL_US = 200_000
# Poses that may be anywhere, and exact observations.
CONFIG = RefineConfig(
    pose_iteration_count=15,
    pose_interval_us=INTERVAL_US,
    pose_noise_px=0.01,
    pose_drift_deg=2.0,
    pose_drift_m=0.05,
    max_residual_px=20.0,
)

DRIFT = Drift.configured(CONFIG)


def error(seed=0, size_rad=0.004, size_m=0.006):
    """Something wrong with the poses that a correction can undo."""
    none = PoseCorrection.none(trajectory(), INTERVAL_US)
    rng = np.random.default_rng(seed)
    control = rng.normal(size=(len(none), 6)) * ([size_rad] * 3 + [size_m] * 3)
    return none.stepped(control)


def seen(world, wrong=None):
    """What is detected, with poses that are off."""
    frames = world.frames
    if wrong is not None:
        poses = wrong.applied(frames.t_us, frames.T_world_camera)
        frames = dataclasses.replace(frames, T_world_camera=poses)
    return Detected(
        frames=frames,
        observations=world.observations,
        evidence=world.evidence(CONFIG),
        pieces=observed(),
        images={},
    )


def lines_of(world, detected, lines=None):
    """Lines with their tracks, as they are."""
    stay = dataclasses.replace(CONFIG, iteration_count=0)
    return refine_lines(
        world.lines if lines is None else lines,
        world.tracks,
        detected.evidence,
        detected.frames,
        stay,
    )


def corrected(found, detected):
    return found.correction.applied(detected.frames.t_us, detected.frames.T_world_camera)


def aligned_errors(poses, truth):
    """Errors after the best similarity: what lines cannot tell is left out."""
    fit = align_points(poses.translation, truth.translation, with_scale=True)
    moved = SE3(
        rotation=fit.T_target_source.rotation @ poses.rotation,
        translation=fit.apply(poses.translation),
    )
    return translation_errors_m(moved, truth), rotation_errors_rad(moved, truth)


class TestRecovery:
    @pytest.mark.parametrize("seed", [0, 1])
    def test_lines_and_poses_are_found_together(self, seed):
        exact = world()
        detected = seen(exact, error(seed))
        start = lines_of(exact, detected, perturbed(exact.lines, 0.01, 0.01))
        none = PoseCorrection.none(trajectory(), INTERVAL_US)
        found = refine_jointly(start, none, DRIFT, detected, CONFIG, None)
        truth = exact.frames.T_world_camera
        before_m, before_rad = aligned_errors(detected.frames.T_world_camera, truth)
        after_m, after_rad = aligned_errors(corrected(found, detected), truth)
        # What is left is the pull of the prior along what the lines hardly tell.
        assert after_m.mean() < 0.1 * before_m.mean()
        assert after_rad.mean() < 0.1 * before_rad.mean()
        assert found.costs[-1] < 0.01 * found.costs[0]
        # Exact observations end on their lines: all that they were off is gone.
        views = views_of(detected.observations, detected.frames).take(start.tracks.observation)
        lines = start.lines.take(start.tracks.track_of_row)
        focal_px = detected.frames.focal_px
        off_px = np.abs(end_residuals_px(views, lines.direction, lines.moment, focal_px)).max(
            axis=1
        )
        assert found.moved_px == pytest.approx(np.sqrt(np.mean(off_px**2)), rel=0.05)

    def test_poses_are_found_among_lines_that_stay(self):
        exact = world()
        detected = seen(exact, error())
        none = PoseCorrection.none(trajectory(), INTERVAL_US)
        start = lines_of(exact, detected)
        found = refine_jointly(start, none, DRIFT, detected, CONFIG, None, free_lines=False)
        truth = exact.frames.T_world_camera
        # The correction is one of tangents, which do not quite add up: 1e-2 rad squared.
        assert translation_errors_m(corrected(found, detected), truth).max() < 5e-4
        assert rotation_errors_rad(corrected(found, detected), truth).max() < 3e-4
        np.testing.assert_allclose(found.lines.moment, exact.lines.moment, atol=1e-12)

    def test_the_truth_stays_where_it_is(self):
        exact = world()
        detected = seen(exact)
        none = PoseCorrection.none(trajectory(), INTERVAL_US)
        found = refine_jointly(lines_of(exact, detected), none, DRIFT, detected, CONFIG, None)
        assert np.abs(found.correction.control).max() < 1e-6
        assert found.moved_px < 1e-3
        assert line_errors(found.lines, exact.segments).max() < 3e-6

    def test_the_drift_of_the_poses_is_learned(self):
        exact = world()
        none = PoseCorrection.none(trajectory(), INTERVAL_US)
        sigmas = {}
        for size in (0.0, 1.0):
            detected = seen(exact, error(size_rad=0.004 * size, size_m=0.006 * size))
            start = lines_of(exact, detected)
            found = refine_jointly(start, none, DRIFT, detected, CONFIG, None, free_lines=False)
            sigmas[size] = found.drift
        # Control points that know nothing of each other wander faster than the drift expects.
        assert 0.004 < sigmas[1.0].sigma_rad < 0.02
        assert 0.006 < sigmas[1.0].sigma_m < 0.03
        assert sigmas[0.0].sigma_rad < 0.02 * DRIFT.sigma_rad
        assert sigmas[0.0].sigma_m < 0.02 * DRIFT.sigma_m

    def test_no_steps_leave_everything(self):
        exact = world()
        detected = seen(exact, error())
        still = dataclasses.replace(CONFIG, pose_iteration_count=0)
        none = PoseCorrection.none(trajectory(), INTERVAL_US)
        found = refine_jointly(lines_of(exact, detected), none, DRIFT, detected, still, None)
        assert not found.correction.control.any()
        assert not found.converged


class TestFocalLength:
    @pytest.mark.parametrize("free_lines", [True, False])
    def test_what_it_lacks_is_told(self, free_lines):
        exact = world()
        K = exact.frames.K.copy()
        # A camera whose focal length is given 2 % too small.
        K[:2, :2] /= 1.02
        detected = seen(exact)
        frames = dataclasses.replace(detected.frames, K=K)
        scale = np.array([1.0, 1.0, 1.0, 1.02, 1.02, 1.0])
        evidence = dataclasses.replace(
            detected.evidence,
            views=views_of(exact.observations, frames),
            event_forms=scale[:, None] * detected.evidence.event_forms * scale,
            segment_forms=scale[:, None] * detected.evidence.segment_forms * scale,
        )
        wrong = dataclasses.replace(detected, frames=frames, evidence=evidence)
        none = PoseCorrection.none(trajectory(), INTERVAL_US)
        for case, share in ((detected, 0.0), (wrong, 0.02)):
            start = lines_of(exact, case)
            found = refine_jointly(start, none, DRIFT, case, CONFIG, None, free_lines=free_lines)
            assert found.focal_error.share == pytest.approx(share, abs=0.005)
            assert found.focal_error.exceeds(0.01, 4.0) == (share > 0.0)


class TestGradient:
    """The gradients are those of half the cost."""

    @pytest.mark.parametrize("scale", [1.0, 100.0])
    def test_they_agree_with_central_differences(self, scale):
        noisy = world(scale, noise_px=0.5, event_noise_px=0.5)
        detected = seen(noisy)
        start = lines_of(noisy, detected)
        wrong = PoseCorrection.none(trajectory(), INTERVAL_US)
        rng = np.random.default_rng(0)
        spread = [0.003] * 3 + [0.003 * scale] * 3
        wrong = wrong.stepped(rng.normal(size=(len(wrong), 6)) * spread)
        config = dataclasses.replace(CONFIG, pose_drift_m=0.05 * scale)
        problem = _Problem(start, wrong, detected, config, None, free_lines=True)
        moment = plucker.shift_origin(start.lines.direction, start.lines.moment, problem.origin)
        U, phi = plucker.orthonormal_from_plucker(start.lines.direction, moment)
        drift = Drift.configured(config)
        state = _State(
            lines=OrthonormalLines(U=U, phi=phi), correction=wrong, drift=drift, drift_told=drift
        )
        weight = rng.uniform(0.1, 1.0, len(problem.line))
        system = problem.system(state, weight)

        def cost_of(state):
            lines = problem.line_costs(state.lines, problem.moved_poses(state), weight)
            return lines.sum() + problem.drift_cost(state)

        assert cost_of(state) == pytest.approx(system.cost, rel=1e-12)

        def cost(line_step, control_step):
            moved = plucker.retract_orthonormal(U, phi, line_step)
            lines = OrthonormalLines(U=moved[0], phi=moved[1])
            stepped = _State(
                lines=lines, correction=wrong.stepped(control_step), drift=drift, drift_told=drift
            )
            return cost_of(stepped)

        no_line, no_control = np.zeros((len(phi), 4)), np.zeros((len(wrong), 6))
        gradient = 2.0 * system.control_gradient.reshape(-1, 6)
        for axis in range(6):
            size = 1e-6 * (scale if axis >= 3 else 1.0)
            step = no_control.copy()
            step[4, axis] = size
            numeric = (cost(no_line, step) - cost(no_line, -step)) / (2 * size)
            largest = np.abs(gradient[:, axis]).max()
            assert numeric == pytest.approx(gradient[4, axis], abs=1e-4 * largest)
        for axis in range(3):
            step = no_line.copy()
            step[2, axis] = 1e-6
            numeric = (cost(step, no_control) - cost(-step, no_control)) / 2e-6
            by_line = 2.0 * system.line_gradient
            assert numeric == pytest.approx(by_line[2, axis], abs=1e-4 * np.abs(by_line[2]).max())

    def test_elimination_solves_the_whole_system(self):
        noisy = world(noise_px=0.5, event_noise_px=0.5)
        detected = seen(noisy, error())
        start = lines_of(noisy, detected)
        none = PoseCorrection.none(trajectory(), INTERVAL_US)
        problem = _Problem(start, none, detected, CONFIG, None, free_lines=True)
        state = problem.first_state(start.lines, none, DRIFT)
        weight = problem.weight(state, loose=True)
        system = problem.system(state, weight)
        line_count, size = len(start), 6 * len(none)
        whole = np.zeros((4 * line_count + size, 4 * line_count + size))
        for line in range(line_count):
            at = slice(4 * line, 4 * line + 4)
            whole[at, at] = system.line_hessian[line]
        shares = problem.shares.toarray()[problem.frame_of[problem.observation]]
        for line, rows, share in zip(problem.line, system.rows, shares, strict=True):
            whole[4 * line : 4 * line + 4, 4 * line_count :] += np.kron(share, rows)
        whole[4 * line_count :, : 4 * line_count] = whole[: 4 * line_count, 4 * line_count :].T
        whole[4 * line_count :, 4 * line_count :] = system.control_hessian
        gradient = np.concatenate([system.line_gradient.ravel(), system.control_gradient])
        step = -np.linalg.solve(whole, gradient)[4 * line_count :]
        moved, _ = problem.step(state, system, problem.reduced(system, 0.0), weight)
        np.testing.assert_allclose(
            moved.correction.control.ravel(), step, atol=1e-5 * np.abs(step).max()
        )


def test_a_line_far_from_its_direction_is_hardly_held_to_it():
    exact = world()
    detected = seen(exact)
    start = lines_of(exact, detected)
    turned = np.roll(start.lines.direction, 1, axis=0)
    prior = DirectionPrior(direction=turned, weight=np.full(len(start), 1e3))
    held = _believed(prior, start.lines, CONFIG)
    sine = np.linalg.norm(np.cross(start.lines.direction, turned), axis=-1)
    assert (held.weight[sine > 0.5] < 1e-4 * 1e3).all()
    own = dataclasses.replace(prior, direction=start.lines.direction)
    np.testing.assert_allclose(_believed(own, start.lines, CONFIG).weight, 1e3)
