"""Where to look for a camera that is out of sight, and how far around."""

from __future__ import annotations

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.geometry.se3 import SE3, rotation_from_vector
from roel_service.tracking.motion import MotionState

# A camera without events goes on as before for so long, at the most.
MAX_COAST_S = 1.0
# It may have come off that by so much for every second of it.
COAST_SIGMA_DEG_S, COAST_SIGMA_M_S = 20.0, 0.3
# And while it is out of sight, its turns being seen, by so much a second, for so long.
WANDER_DEG_S, WANDER_M_S, MAX_WANDER_S = 5.0, 0.2, 3.0
# A shift aside looks like a turn: up to this share of what is seen may be one, of a scene that is
# this share of the map's extent away.
MAX_SHIFT_SHARE, DEPTH_SHARE = 0.6, 0.25
# Turns that are remembered, one a window.
MAX_TURN_COUNT = 200


class Whereabouts:
    """The last place that could be relied on, and what was seen of the motion since.

    Args:
        T_world_camera: where the camera is when it is first looked for, roughly.
        extent_m: of the map.
    """

    def __init__(self, T_world_camera: SE3, extent_m: float) -> None:
        self._place = T_world_camera
        self._depth_m = DEPTH_SHARE * extent_m
        self._last: MotionState | None = None
        self._lost_us: int | None = None
        self._turns: list[FloatArray] = []

    def relied_on(self, state: MotionState) -> None:
        """The camera is here."""
        self._last, self._place = state, state.T_world_camera
        self._lost_us = None
        self._turns = []

    def lost(self, t_us: int) -> None:
        """It is out of sight from now on, unless it was so before."""
        if self._lost_us is None:
            self._lost_us = t_us

    def turned(self, turn_rate: FloatArray, after_s: float) -> None:
        """It turned while it was out of sight, by (3,) rad/s in its own axes."""
        if self._lost_us is not None:
            self._turns.append(after_s * turn_rate)
            del self._turns[:-MAX_TURN_COUNT]

    def place(self, t_us: int, attempt: int, rng: np.random.Generator) -> SE3:
        """A place to look at, another one at each attempt."""
        lost_us = t_us if self._lost_us is None else self._lost_us
        wander_s = min(MAX_WANDER_S, (t_us - lost_us) * 1e-6)
        coast_s, place = 0.0, self._place
        if self._last is not None:
            coast_s = min(MAX_COAST_S, max(0, lost_us - self._last.t_us) * 1e-6)
            # First where the motion leads, then where it began, then anywhere on the way.
            share = (1.0, 0.0)[attempt] if attempt < 2 else rng.uniform()
            place = self._last.poses(np.array(share * coast_s))
        turned = self._moved_on(place, rng.uniform(0.0, MAX_SHIFT_SHARE))
        deviation = _deviation(coast_s, COAST_SIGMA_DEG_S, COAST_SIGMA_M_S)
        deviation += _deviation(wander_s, WANDER_DEG_S, WANDER_M_S)
        return turned if attempt < 2 else turned.retract(rng.normal(size=6) * deviation)

    def _moved_on(self, place: SE3, shift_share: float) -> SE3:
        """A place after all turns that were seen, a share of which were shifts."""
        rotation, centre = place.rotation, place.translation
        for turn in self._turns:
            aside = np.array([turn[1], -turn[0], 0.0])
            centre = centre + rotation @ (shift_share * self._depth_m * aside)
            rotation = rotation @ rotation_from_vector((1.0 - shift_share) * turn)
        return SE3(rotation=rotation, translation=centre)


def _deviation(after_s: float, turn_deg_s: float, shift_m_s: float) -> FloatArray:
    """(6,) of a pose step, after a time."""
    return after_s * np.array([np.deg2rad(turn_deg_s)] * 3 + [shift_m_s] * 3)
