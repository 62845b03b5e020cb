"""Another answer beside the one that is followed.

A fit starts where the pose would be if it were far more in error than it is said to be. From the right
place it comes back; beside a wrong one, or where little tells places apart, it ends elsewhere and
explains as much or more. The covariance of a pose cannot tell: it is of one association of events and
lines.
"""

from __future__ import annotations

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.config.stages import TrackConfig
from roel_service.tracking.fit import Window, WindowFit, fit_window
from roel_service.tracking.locate import EVENT_SCALES_PX, is_same_pose, roughly_at
from roel_service.tracking.motion import MotionState
from roel_service.tracking.sight import Eyes

# A start is between so many deviations away from the pose, to the reach at the most.
LEAST_SIGMA_COUNT, MOST_SIGMA_COUNT = 10.0, 40.0
# Scales of the rounds, px, and how many events are enough for them.
SCALES_PX = (8.0, 4.0, 2.0, 1.0)
EVENT_COUNT = 4_000


def challengers(
    state: MotionState, window: Window, eyes: Eyes, config: TrackConfig, rng: np.random.Generator
) -> list[WindowFit]:
    """Another answer for a window, or none where the fit comes back.

    Args:
        state: the answer that is challenged.
        rng: draws where the fit starts.
    """
    place = state.T_world_camera.retract(_far_off(state, config, rng))
    start = roughly_at(place, state.velocity, window.t_us, config)
    few = window.thinned(EVENT_COUNT)
    rough = fit_window(start, few, eyes.pieces, eyes.view, config, SCALES_PX)
    if is_same_pose(rough.state, state):
        return []
    return [fit_window(rough.state, window, eyes.pieces, eyes.view, config, EVENT_SCALES_PX)]


def _far_off(state: MotionState, config: TrackConfig, rng: np.random.Generator) -> FloatArray:
    """(6,) step of the pose: large for its covariance, mostly along what is known least."""
    axis = rng.normal(size=6)
    axis /= np.linalg.norm(axis)
    sigma_count = np.exp(rng.uniform(np.log(LEAST_SIGMA_COUNT), np.log(MOST_SIGMA_COUNT)))
    step = sigma_count * np.linalg.cholesky(state.covariance[:6, :6]) @ axis
    turn_rad, shift_m = np.linalg.norm(step.reshape(2, 3), axis=1)
    beyond = max(turn_rad / np.deg2rad(config.reach_deg), shift_m / config.reach_m)
    return np.asarray(step / max(1.0, beyond))
