import dataclasses

import numpy as np
import pytest

from roel_service.config.presets import preset
from roel_service.errors import LimitError
from roel_service.geometry.alignment import align_points
from roel_service.mapping import batch
from roel_service.mapping.batch import _Problem, _State, refine_batch
from roel_service.mapping.front_end import Detected
from roel_service.mapping.refine import OrthonormalLines, refine_lines
from roel_service.scene.lines import LineTracks

from .synthetic import observed, world

PAPER = dataclasses.replace(preset("paper").refine, pose_iteration_count=40)
LIMAP = dataclasses.replace(
    PAPER, residual="reprojection", loss="cauchy", loss_scale_px=1.0, event_weight=0.0
)
CONFIGS = {
    "grassmann": PAPER,
    "lines alone": dataclasses.replace(PAPER, event_weight=0.0),
    "quartic": dataclasses.replace(PAPER, loss="quartic"),
    "reprojection": LIMAP,
}


def seen(world, config, wrong=None):
    frames = world.frames
    if wrong is not None:
        frames = dataclasses.replace(frames, T_world_camera=frames.T_world_camera.retract(wrong))
    return Detected(
        frames=frames,
        observations=world.observations,
        evidence=world.evidence(config),
        pieces=observed(),
        images={},
    )


def wrong_poses(world, seed=0):
    """Every pose off by itself, but for the first."""
    rng = np.random.default_rng(seed)
    wrong = rng.normal(size=(len(world.frames), 6)) * ([0.01] * 3 + [0.02] * 3)
    wrong[0] = 0.0
    return wrong


def lines_of(world, config):
    """The true lines with their tracks."""
    detected = seen(world, config)
    stay = dataclasses.replace(config, iteration_count=0)
    return refine_lines(world.lines, world.tracks, detected.evidence, detected.frames, stay)


def ate_m(poses, truth):
    """After the best similarity: noise of the given path is in its scale."""
    fit = align_points(poses.translation, truth.translation, with_scale=True)
    off = fit.apply(poses.translation) - truth.translation
    return float(np.sqrt(np.mean(np.sum(off**2, axis=-1))))


@pytest.mark.parametrize("name", CONFIGS)
def test_poses_and_lines_are_found_from_exact_observations(name):
    exact, config = world(), CONFIGS[name]
    detected = seen(exact, config, wrong_poses(exact))
    truth = exact.frames.T_world_camera
    before_m = ate_m(detected.frames.T_world_camera, truth)
    found = refine_batch(lines_of(exact, config), detected, config)
    # Near the solution a fourth power hardly pulls.
    assert ate_m(found.T_world_camera, truth) < (0.2 if name == "quartic" else 0.02) * before_m
    assert (np.diff(found.costs) <= 0.0).all()
    assert found.costs[-1] < 1e-2 * found.costs[0]


def test_the_first_pose_is_held():
    exact = world()
    detected = seen(exact, PAPER, wrong_poses(exact))
    found = refine_batch(lines_of(exact, PAPER), detected, PAPER)
    first = detected.frames.T_world_camera[0]
    np.testing.assert_allclose(found.T_world_camera[0].matrix(), first.matrix(), atol=1e-12)


def test_a_frame_that_sees_hardly_any_line_keeps_its_pose():
    exact = world()
    detected = seen(exact, PAPER, wrong_poses(exact))
    lines = lines_of(exact, PAPER)
    tracks, poor = lines.tracks, 5
    is_seen = detected.observations.frame[tracks.observation] != poor
    is_seen[np.flatnonzero(~is_seen)[: batch.MIN_ROW_COUNT - 1]] = True
    tracks = LineTracks.from_rows(
        tracks.track_of_row[is_seen], tracks.observation[is_seen], len(tracks)
    )
    found = refine_batch(dataclasses.replace(lines, tracks=tracks), detected, PAPER)
    before, after = detected.frames.T_world_camera, found.T_world_camera
    step_m = np.linalg.norm(after.translation - before.translation, axis=1)
    assert step_m[poor] < 1e-12 < step_m[poor + 1]
    assert not found.covariance[poor].any()
    assert found.covariance[poor + 1].any()


@pytest.mark.parametrize("name", CONFIGS)
def test_the_path_stays_as_large_as_it_is_given(name):
    exact, config = world(), CONFIGS[name]
    detected = seen(exact, config, wrong_poses(exact))
    found = refine_batch(lines_of(exact, config), detected, config)

    def extent_m(poses):
        return np.sqrt(np.mean(np.sum((poses.translation - poses.translation[0]) ** 2, axis=-1)))

    given_m = extent_m(detected.frames.T_world_camera)
    assert extent_m(found.T_world_camera) == pytest.approx(given_m, rel=1e-4)


@pytest.mark.parametrize("name", CONFIGS)
def test_gradients_agree_with_central_differences(name):
    config = CONFIGS[name]
    noisy = world(noise_px=0.5, event_noise_px=0.5)
    detected = seen(noisy, config, 0.1 * wrong_poses(noisy))
    problem = _Problem(lines_of(noisy, config), detected, config)
    state = problem.first_state(noisy.lines, detected.frames.T_world_camera)
    gradient, _ = problem.normal_equations(problem.terms(state))
    line_count = problem.line_count

    def cost(unknown, size):
        step = np.zeros(len(gradient))
        step[unknown] = size
        by_pose = np.concatenate([np.zeros(6), step[4 * line_count :]]).reshape(-1, 6)
        U, phi = batch.plucker.retract_orthonormal(
            state.lines.U, state.lines.phi, step[: 4 * line_count].reshape(-1, 4)
        )
        lines = OrthonormalLines(U=U, phi=phi)
        return problem.cost(_State(lines=lines, poses=state.poses.retract(by_pose)))

    largest = np.abs(gradient[4 * line_count :]).max()
    for unknown in range(4 * line_count, 4 * line_count + 6):
        slope = (cost(unknown, 1e-6) - cost(unknown, -1e-6)) / 2e-6
        assert slope == pytest.approx(2.0 * gradient[unknown], abs=1e-4 * largest)


def test_the_covariance_is_as_large_as_the_errors_that_noise_makes():
    noisy, config = world(noise_px=0.3), CONFIGS["lines alone"]
    found = refine_batch(lines_of(noisy, config), seen(noisy, config), config)
    assert not found.covariance[0].any()
    assert np.linalg.eigvalsh(found.covariance[1:]).min() > 0.0
    off = found.T_world_camera.translation - noisy.frames.T_world_camera.translation
    told_m = np.sqrt(np.trace(found.covariance[:, 3:, 3:], axis1=1, axis2=2).mean())
    assert 0.3 < np.sqrt(np.mean(np.sum(off**2, axis=-1))) / told_m < 3.0


def test_too_many_unknowns_are_refused(monkeypatch):
    exact = world()
    monkeypatch.setattr(batch, "MAX_UNKNOWN_COUNT", 10)
    with pytest.raises(LimitError, match="at most 10 unknowns") as caught:
        refine_batch(lines_of(exact, PAPER), seen(exact, PAPER), PAPER)
    assert caught.value.reason == "RECORDING_TOO_LONG"
