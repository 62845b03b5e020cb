"""A search for the camera in one window, a slice of it in each later one.

A search takes as long as ten windows do, or more. It goes on a slice at a time, so that no pose waits
for all of it, and follows what it finds through the windows that came meanwhile.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Generator

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.config.stages import TrackConfig
from roel_service.geometry.se3 import SE3
from roel_service.scene.events import EventStream
from roel_service.tracking.fit import Window
from roel_service.tracking.follower import Follower
from roel_service.tracking.locate import locating
from roel_service.tracking.pursuit import Pursuit
from roel_service.tracking.sight import Eyes, looking
from roel_service.tracking.verdict import is_possible

# A slice is as much as takes about so long, as the steps tell beforehand: the clock has no say, so that
# the same events give the same poses.
SLICE_MS = 27.0
# What a fit in one of the windows that came meanwhile takes, of about so many events.
FIT_MS, EVENT_COUNT = 5.0, 6_000


class Search:
    """What is found around a place in one window, followed until it is up to date.

    Args:
        place: rough `T_world_camera`.
        turn_rate: (3,) rad/s in the camera's own axes.
        window: the one that is searched.
        around: events around its middle.
        eyes: with which the camera is looked for.
        config: parameters.
        rng: draws what is tried.
        before: what an answer explains counts so many times, in place of windows before it.

    Attributes:
        found: what is left of the answers in the last window; None while the search goes on.
    """

    def __init__(
        self,
        place: SE3,
        turn_rate: FloatArray,
        window: Window,
        around: EventStream,
        eyes: Eyes,
        config: TrackConfig,
        rng: np.random.Generator,
        before: float = 1.0,
    ) -> None:
        self.found: Pursuit | None = None
        self._waiting: deque[Window] = deque()
        self._eyes, self._config, self._rng = eyes, config, rng
        self._steps = self._searching(place, turn_rate, window, around, before)
        # Of the next step.
        self._ahead_ms = 0.0

    def see(self, window: Window) -> None:
        """Another window has come."""
        self._waiting.append(window.thinned(EVENT_COUNT))

    def go_on(self) -> None:
        """Do the next slice: as many steps as fit, at least one."""
        spent_ms = 0.0
        while self.found is None and (spent_ms == 0.0 or spent_ms + self._ahead_ms <= SLICE_MS):
            spent_ms += self._ahead_ms
            self._ahead_ms = next(self._steps, 0.0)

    def finish(self) -> None:
        """Do all of them."""
        for _ in self._steps:
            pass

    def _searching(
        self,
        place: SE3,
        turn_rate: FloatArray,
        window: Window,
        around: EventStream,
        before: float,
    ) -> Generator[float, None, None]:
        eyes, config, rng = self._eyes, self._config, self._rng
        sight = yield from looking(around, window.t_us, eyes, turn_rate)
        fits = yield from locating(place, sight, window, eyes, config, rng)
        answers = [Follower(fit, before) for fit in fits if is_possible(fit, config)]
        pursuit = Pursuit(answers, eyes, config)
        while self._waiting and not pursuit.is_over:
            # Two, since one comes meanwhile.
            yield 2.0 * FIT_MS * len(pursuit.followers)
            for _ in range(2):
                if self._waiting and not pursuit.is_over:
                    pursuit.follow(self._waiting.popleft())
        for follower in pursuit.followers:
            follower.begin_anew()
        self.found = pursuit
