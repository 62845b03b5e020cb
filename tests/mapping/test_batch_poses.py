import dataclasses

import numpy as np
import pytest

from roel_service.config.presets import preset
from roel_service.errors import ConfigError
from roel_service.geometry.alignment import align_points
from roel_service.mapping.batch import BatchRefined
from roel_service.mapping.batch_poses import _corrected
from roel_service.mapping.refine_poses import refine_poses
from roel_service.scene.trajectory import Trajectory

from .synthetic import CAMERA, event_stream, trajectory, world
from .test_batch import seen, wrong_poses
from .test_pipeline import PAPER


def noisy_trajectory():
    """Good enough for the published pipeline to triangulate lines with."""
    truth, rng = trajectory(), np.random.default_rng(0)
    jitter = rng.normal(size=(len(truth), 6)) * ([3e-4] * 3 + [6e-4] * 3)
    return Trajectory(t_us=truth.t_us, T_world_camera=truth.T_world_camera.retract(jitter))


@pytest.fixture(scope="module")
def found():
    return refine_poses(event_stream(), noisy_trajectory(), CAMERA, PAPER)


def test_the_published_preset_refines_in_one_batch(found):
    assert preset("paper").refine.pose_method == "batch"
    assert preset("default").refine.pose_method == "smooth"
    assert found.report.line_count >= 6
    assert found.report.iteration_count > 0
    # The batch holds the first pose, and is as sure of it.
    assert not found.covariance[0].any()
    assert np.isinf(found.report.time_offset_sigma_us)


@pytest.mark.parametrize("estimated", ["estimate_time_offset", "estimate_intrinsics"])
def test_the_batch_estimates_nothing_but_poses(estimated):
    with pytest.raises(ConfigError, match=r"refine\.pose_method: expected smooth"):
        refine_poses(event_stream(), noisy_trajectory(), CAMERA, PAPER, **{estimated: True})


def test_poses_are_those_of_the_given_times(found):
    given = noisy_trajectory()
    np.testing.assert_array_equal(found.trajectory.t_us, given.t_us)
    paths = (found.trajectory.T_world_camera, given.T_world_camera)
    fit = align_points(*(poses.translation for poses in paths), with_scale=True)
    assert fit.scale == pytest.approx(1.0, abs=1e-9)
    assert found.covariance.shape == (len(given), 6, 6)


def test_poses_of_frames_are_turned_as_the_batch_turned_them():
    exact = world()
    detected = seen(exact, PAPER.refine)
    frames = detected.frames
    turned = frames.T_world_camera.retract(wrong_poses(exact))
    batch = BatchRefined(
        lines=exact.lines,
        T_world_camera=turned,
        covariance=np.zeros((len(frames), 6, 6)),
        costs=[],
        converged=True,
    )
    given = Trajectory(t_us=frames.t_us, T_world_camera=frames.T_world_camera)
    corrected = _corrected(given, detected, batch).rotation
    steps = corrected[1:] @ np.swapaxes(corrected[:-1], -1, -2)
    expected = turned.rotation[1:] @ np.swapaxes(turned.rotation[:-1], -1, -2)
    # All are turned by one rotation more, which puts the path where it was given.
    traces = np.trace(steps, axis1=1, axis2=2), np.trace(expected, axis1=1, axis2=2)
    np.testing.assert_allclose(*traces, atol=1e-9)


def test_a_residual_that_the_batch_has_not_is_refused():
    pixel = dataclasses.replace(PAPER, refine=dataclasses.replace(PAPER.refine, residual="pixel"))
    with pytest.raises(ConfigError, match="grassmann or reprojection"):
        refine_poses(event_stream(), noisy_trajectory(), CAMERA, pixel)
