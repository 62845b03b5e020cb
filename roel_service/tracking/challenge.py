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
from roel_service.tracking.follower import RIVAL_SHARE, Follower
from roel_service.tracking.locate import EVENT_SCALES_PX, is_same_pose, roughly_at
from roel_service.tracking.motion import MotionState
from roel_service.tracking.sight import Eyes
from roel_service.tracking.verdict import is_possible

# A start is between so many deviations away from the pose, to the reach at the most.
LEAST_SIGMA_COUNT, MOST_SIGMA_COUNT = 10.0, 40.0
# Scales of the rounds, px, and how many events are enough for them.
SCALES_PX = (8.0, 4.0, 2.0, 1.0)
EVENT_COUNT = 4_000


class Challenge:
    """Another answer for a window, looked for while the one that is challenged is followed further.

    Args:
        follower: the answer, with the window's fit.
        rng: draws where the fit starts.
    """

    def __init__(
        self,
        follower: Follower,
        window: Window,
        eyes: Eyes,
        config: TrackConfig,
        rng: np.random.Generator,
    ) -> None:
        # The follower goes on meanwhile.
        self._fit, self._before = follower.fit, follower.before
        self._window, self._eyes, self._config = window, eyes, config
        place = follower.state.T_world_camera.retract(_far_off(follower.state, config, rng))
        self._start = roughly_at(place, follower.state.velocity, window.t_us, config)

    def others(self) -> list[Follower]:
        """A rival, as if it had been followed so far, or none."""
        return [Follower(fit, self._before) for fit in self._fits() if self._is_rival(fit)]

    def _fits(self) -> list[WindowFit]:
        """Where the fit ends, unless it comes back."""
        pieces, view = self._eyes.pieces, self._eyes.view
        few = self._window.thinned(EVENT_COUNT)
        rough = fit_window(self._start, few, pieces, view, self._config, SCALES_PX)
        if is_same_pose(rough.state, self._fit.state):
            return []
        return [fit_window(rough.state, self._window, pieces, view, self._config, EVENT_SCALES_PX)]

    def _is_rival(self, fit: WindowFit) -> bool:
        least_count = RIVAL_SHARE * self._fit.evidence.explained_count
        return (
            is_possible(fit, self._config)
            and fit.evidence.explained_count >= least_count
            and not is_same_pose(fit.state, self._fit.state)
        )


def _far_off(state: MotionState, config: TrackConfig, rng: np.random.Generator) -> FloatArray:
    """(6,) step of the pose: large for its covariance, mostly along what is known least."""
    axis = rng.normal(size=6)
    axis /= np.linalg.norm(axis)
    sigma_count = np.exp(rng.uniform(np.log(LEAST_SIGMA_COUNT), np.log(MOST_SIGMA_COUNT)))
    step = sigma_count * np.linalg.cholesky(state.covariance[:6, :6]) @ axis
    turn_rad, shift_m = np.linalg.norm(step.reshape(2, 3), axis=1)
    beyond = max(turn_rad / np.deg2rad(config.reach_deg), shift_m / config.reach_m)
    return np.asarray(step / max(1.0, beyond))
