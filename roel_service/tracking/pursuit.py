"""Answers to where the camera is that explain about as much, followed together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from roel_service.config.stages import TrackConfig
from roel_service.scene.results import PoseStatus
from roel_service.tracking.challenge import challengers
from roel_service.tracking.fit import Window, WindowFit
from roel_service.tracking.follower import Follower, rivals
from roel_service.tracking.locate import is_same_pose
from roel_service.tracking.sight import Eyes
from roel_service.tracking.verdict import is_possible


class Pursuit:
    """Followers of one camera, and what challenges the last of them.

    Args:
        followers: what was found; none is a pursuit that is over.
        eyes: with which it is followed.
        config: parameters.
        rng: draws the challenges.

    Attributes:
        followers: the best first.
    """

    def __init__(
        self,
        followers: Sequence[Follower],
        eyes: Eyes,
        config: TrackConfig,
        rng: np.random.Generator,
    ) -> None:
        self._eyes, self._config, self._rng = eyes, config, rng
        self.followers = rivals(followers)

    @property
    def is_over(self) -> bool:
        """Whether every answer is lost."""
        return not self.followers

    @property
    def status(self) -> PoseStatus:
        """What is known of the camera."""
        if self.is_over:
            return PoseStatus.LOST
        best, *others = self.followers
        return PoseStatus.UNCERTAIN if others else best.status

    def follow(self, window: Window) -> WindowFit:
        """Go on to the next window, and tell what it says of the best answer, though it be lost."""
        for follower in self.followers:
            follower.follow(window, self._eyes, self._config)
        best = max(self.followers, key=lambda each: each.explained_count)
        alive = [each for each in self.followers if each.status is not PoseStatus.LOST]
        self.followers = rivals(alive)
        return best.fit

    def join(self, others: Sequence[Follower]) -> None:
        """Take up answers of the same window that are not known yet."""
        new = [
            other
            for other in others
            if not any(is_same_pose(other.state, known.state) for known in self.followers)
        ]
        self.followers = rivals([*self.followers, *new])

    def challengers(self, window: Window) -> list[Follower]:
        """Other answers for the last window, where only one is left; they are not joined yet.

        Args:
            window: the last one.
        """
        if len(self.followers) != 1 or self.followers[0].fit.evidence.is_still:
            return []
        follower = self.followers[0]
        fits = challengers(follower.state, window, self._eyes, self._config, self._rng)
        return [follower.instead(fit) for fit in fits if is_possible(fit, self._config)]
