import numpy as np

from roel_service.config.stages import TrackConfig
from roel_service.geometry.se3 import SE3
from roel_service.tracking.motion import MotionState

STATE = MotionState(
    t_us=1_000_000,
    T_world_camera=SE3.identity().retract(np.array([0.1, -0.2, 0.3, 1.0, 2.0, 3.0])),
    velocity=np.array([0.5, 0.0, -0.4, 0.3, -0.1, 0.2]),
    covariance=np.diag(np.linspace(1e-4, 1e-3, 12)),
)


def test_an_even_motion_goes_on():
    later = STATE.foretold(1_250_000, TrackConfig())
    moved = STATE.T_world_camera.local(later.T_world_camera)
    np.testing.assert_allclose(moved, 0.25 * STATE.velocity, atol=1e-12)
    np.testing.assert_array_equal(later.velocity, STATE.velocity)


def test_what_is_known_fades_as_time_passes():
    soon, late = (
        STATE.foretold(1_000_000 + after_us, TrackConfig()) for after_us in (10**4, 10**5)
    )
    for fresh, faded in ((STATE, soon), (soon, late)):
        assert (np.linalg.eigvalsh(faded.covariance - fresh.covariance)[6:] > 0.0).all()


def test_one_long_forecast_is_as_uncertain_as_two_short_ones():
    config = TrackConfig()
    once = STATE.foretold(1_040_000, config)
    twice = STATE.foretold(1_015_000, config).foretold(1_040_000, config)
    np.testing.assert_allclose(once.covariance, twice.covariance, rtol=1e-9)
