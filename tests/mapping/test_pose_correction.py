import numpy as np
import pytest

from roel_service.config.stages import RefineConfig
from roel_service.errors import LimitError
from roel_service.mapping.pose_correction import Drift, PoseCorrection

from .synthetic import DURATION_US, trajectory

INTERVAL_US = 100_000


def correction(control=None):
    none = PoseCorrection.none(trajectory(), INTERVAL_US)
    return none if control is None else none.stepped(control)


def test_no_correction_changes_nothing():
    given = trajectory()
    found = correction().trajectory(given)
    np.testing.assert_array_equal(found.t_us, given.t_us)
    np.testing.assert_allclose(found.T_world_camera.matrix(), given.T_world_camera.matrix())


def test_control_points_cover_the_trajectory_and_are_close_enough():
    found = correction()
    assert found.interval_us <= INTERVAL_US
    assert len(found) == DURATION_US // INTERVAL_US + 3


def test_shares_are_a_partition_of_one_without_negative_parts():
    shares = correction().shares(trajectory().t_us)
    assert shares.min() > -1e-12
    np.testing.assert_allclose(shares.sum(axis=1), 1.0, atol=1e-12)


def test_straight_control_points_give_a_straight_correction():
    found = correction()
    centre_us = found.first_us + (np.arange(len(found)) - 1) * found.interval_us
    moved = found.stepped(np.outer(centre_us * 1e-6, [0, 0, 0, 1, 2, 3]))
    t_us = trajectory().t_us
    shift = moved.shares(t_us) @ moved.control
    np.testing.assert_allclose(shift[:, 3:], np.outer(t_us * 1e-6, [1, 2, 3]), atol=1e-12)


def test_the_correction_has_no_jumps():
    rng = np.random.default_rng(0)
    moved = correction(rng.normal(size=(len(correction()), 6)))
    around_us = np.arange(INTERVAL_US - 2, INTERVAL_US + 3)
    steps = np.diff(moved.shares(around_us) @ moved.control, axis=0)
    # Twice differentiable: over a microsecond the step changes by 1e-10 of the control points.
    np.testing.assert_allclose(steps, steps[[0]].repeat(4, axis=0), atol=1e-8)


def test_drift_is_that_of_an_odometry_that_forgets():
    config = RefineConfig(pose_drift_deg=0.5, pose_drift_m=0.02, pose_drift_s=0.7)
    found = correction()
    covariance = np.linalg.inv(Drift.configured(config).information(found))
    count = len(found)
    apart_s = np.abs(np.subtract.outer(np.arange(count), np.arange(count))) * found.interval_us
    expected = np.exp(-apart_s * 1e-6 / 0.7)
    by_time = covariance.reshape(count, 6, count, 6)
    np.testing.assert_allclose(by_time[:, 0, :, 0], np.deg2rad(0.5) ** 2 * expected, atol=1e-12)
    np.testing.assert_allclose(by_time[:, 5, :, 5], 0.02**2 * expected, atol=1e-12)
    assert not by_time[:, 0, :, 1].any()


def test_a_drift_pulls_by_its_information():
    drift = Drift(sigma_rad=0.01, sigma_m=0.02, forgets_s=0.7)
    found = correction(np.random.default_rng(0).normal(size=(len(correction()), 6)))
    pull = drift.information(found) @ found.control.ravel()
    np.testing.assert_allclose(drift.pull(found).ravel(), pull, rtol=1e-9)


def test_the_size_of_a_drift_is_found_from_a_correction():
    true = Drift(sigma_rad=0.01, sigma_m=0.2, forgets_s=0.3)
    count = len(correction())
    rng = np.random.default_rng(0)
    spread = np.linalg.cholesky(np.linalg.inv(true.information(correction())))
    drawn = correction((spread @ rng.normal(size=6 * count)).reshape(count, 6))
    known = np.zeros((6 * count, 6 * count))
    expected = Drift(sigma_rad=1.0, sigma_m=1.0, forgets_s=0.3)
    found = expected.estimated(drawn, known)
    assert found.sigma_rad == pytest.approx(true.sigma_rad, rel=0.25)
    assert found.sigma_m == pytest.approx(true.sigma_m, rel=0.25)
    # What is not observed at all tells nothing: the few unknowns that are left are not divided by.
    unknown = np.linalg.inv(expected.information(correction()))
    assert np.isfinite(expected.estimated(drawn, unknown).sigma_m)
    assert expected.at_least(2.0, true).sigma_m == 1.0
    assert true.at_least(0.5, expected).sigma_m == 0.5


def test_what_lies_beyond_another_drift_is_the_rest_of_its_variance():
    small = Drift(sigma_rad=0.03, sigma_m=0.004, forgets_s=9.0)
    rest = Drift(sigma_rad=0.05, sigma_m=0.003, forgets_s=1.5).beyond(small)
    assert rest.sigma_rad == pytest.approx(0.04)
    assert rest.sigma_m == 0.0
    assert rest.forgets_s == 1.5


def test_too_long_a_recording_is_refused():
    with pytest.raises(LimitError, match=r"at most 1 s at refine\.pose_interval_us") as caught:
        PoseCorrection.none(trajectory(), 1_000)
    assert caught.value.reason == "RECORDING_TOO_LONG"
