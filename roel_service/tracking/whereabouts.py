"""Where to look for a camera that is out of sight, and how far around."""

from __future__ import annotations

import math

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.geometry.se3 import SE3, rotation_from_vector
from roel_service.tracking.motion import MotionState

# A camera without events goes on as before for so long, at the most.
MAX_COAST_S = 1.0
# It may have come off that by so much for every second of it.
COAST_SIGMA_DEG_S, COAST_SIGMA_M_S = 6.0, 0.2
# How it moved is remembered for so long.
MEMORY_US = 1_000_000
# And while it is out of sight, its turns being seen, by so much a second, for so long.
WANDER_DEG_S, WANDER_M_S, MAX_WANDER_S = 5.0, 0.2, 3.0
# A shift aside looks like a turn: up to this share of what is seen may be one, of a scene that is
# this share of the map's extent away.
MAX_SHIFT_SHARE, DEPTH_SHARE = 0.6, 0.25
# A path that is known for less than this share of the time says no more than its last velocity.
MAX_REPEAT_COUNT = 4
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
        self._path: list[MotionState] = []
        self._lost_us: int | None = None
        self._turns: list[FloatArray] = []

    def relied_on(self, state: MotionState) -> None:
        """The camera is here."""
        self._place = state.T_world_camera
        self._path = [one for one in self._path if one.t_us >= state.t_us - MEMORY_US]
        self._path.append(state)
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
        if self._path:
            coast_s = self._coast_s(lost_us, attempt, rng)
            place = _continued(self._path, coast_s)
        turned = self._moved_on(place, rng.uniform(0.0, MAX_SHIFT_SHARE))
        deviation = _deviation(coast_s, COAST_SIGMA_DEG_S, COAST_SIGMA_M_S)
        deviation += _deviation(wander_s, WANDER_DEG_S, WANDER_M_S)
        return turned if attempt < 2 else turned.retract(rng.normal(size=6) * deviation)

    def _coast_s(self, lost_us: int, attempt: int, rng: np.random.Generator) -> float:
        """How far ahead on its way to look at an attempt."""
        # First where the motion leads, then where it began, then there or anywhere ahead: events
        # may be missing from a recording.
        if attempt == 1:
            return 0.0
        if attempt > 1 and rng.uniform() < 0.5:
            return float(rng.uniform(0.0, MAX_COAST_S))
        return min(MAX_COAST_S, max(0, lost_us - self._path[-1].t_us) * 1e-6)

    def _moved_on(self, place: SE3, shift_share: float) -> SE3:
        """A place after all turns that were seen, a share of which were shifts."""
        rotation, centre = place.rotation, place.translation
        for turn in self._turns:
            aside = np.array([turn[1], -turn[0], 0.0])
            centre = centre + rotation @ (shift_share * self._depth_m * aside)
            rotation = rotation @ rotation_from_vector((1.0 - shift_share) * turn)
        return SE3(rotation=rotation, translation=centre)


def _continued(path: list[MotionState], for_s: float) -> SE3:
    """Where a path leads, if it goes on for a time as it did in as long a time before.

    A hand sways: of the motion of one moment little is left a second later.
    """
    last = path[-1]
    known_s = (last.t_us - path[0].t_us) * 1e-6
    if known_s == 0.0 or for_s > MAX_REPEAT_COUNT * known_s:
        return last.poses(np.array(for_s))
    repeat_count = max(1, math.ceil(for_s / known_s))
    before_us = last.t_us - round(1e6 * for_s / repeat_count)
    step = _pose_at(path, before_us).inverse() @ last.T_world_camera
    place = last.T_world_camera
    for _ in range(repeat_count):
        place = place @ step
    return place


def _pose_at(path: list[MotionState], t_us: int) -> SE3:
    """The pose at a time, from the state that is nearest to it."""
    nearest = min(path, key=lambda state: abs(state.t_us - t_us))
    return nearest.poses(np.array((t_us - nearest.t_us) * 1e-6))


def _deviation(after_s: float, turn_deg_s: float, shift_m_s: float) -> FloatArray:
    """(6,) of a pose step, after a time."""
    return after_s * np.array([np.deg2rad(turn_deg_s)] * 3 + [shift_m_s] * 3)
