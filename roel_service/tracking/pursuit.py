"""Answers to where the camera is that explain about as much, followed together."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from roel_service.config.stages import TrackConfig
from roel_service.scene.results import PoseStatus
from roel_service.tracking.challenge import Challenge
from roel_service.tracking.fit import Window, WindowFit
from roel_service.tracking.follower import Follower, rivals
from roel_service.tracking.locate import is_same_pose
from roel_service.tracking.sight import Eyes


class Pursuit:
    """Followers of one camera, and what challenges the last of them.

    Args:
        followers: what was found; none is a pursuit that is over.
        eyes: with which it is followed.
        config: parameters.

    Attributes:
        followers: the best first.
    """

    def __init__(self, followers: Sequence[Follower], eyes: Eyes, config: TrackConfig) -> None:
        self._eyes, self._config = eyes, config
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

    def follow(self, window: Window, others: Callable[[], Sequence[Follower]] = tuple) -> WindowFit:
        """Go on to the next window, and tell what it says of the best answer, though it be lost.

        Args:
            others: waits for what the challenge of the last window has found; it is followed, too.
        """
        for follower in self.followers:
            follower.follow(window, self._eyes, self._config)
        late = others()
        for follower in late:
            follower.follow(window, self._eyes, self._config)
        followers = [*self.followers, *late]
        best = max(followers, key=lambda each: each.explained_count)
        alive = [each for each in followers if each.status is not PoseStatus.LOST]
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

    def challenge(self, window: Window, rng: np.random.Generator) -> Challenge | None:
        """What may find another answer for the last window, where only one is left.

        Args:
            window: the last one.
            rng: draws where it begins.
        """
        if len(self.followers) != 1 or self.followers[0].fit.evidence.is_still:
            return None
        return Challenge(self.followers[0], window, self._eyes, self._config, rng)
