"""One answer to where the camera is, followed from window to window."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.config.stages import TrackConfig
from roel_service.scene.results import PoseStatus
from roel_service.tracking.fit import Window, WindowFit, fit_window
from roel_service.tracking.locate import EVENT_SCALES_PX, UNSURE_SCALES_PX, is_same_pose
from roel_service.tracking.motion import MotionState, faded
from roel_service.tracking.sight import Eyes
from roel_service.tracking.verdict import Verdict, convinces

# A line that was seen so long ago is known to be in sight: it is not hidden, if it has no events.
MEMORY_US = 300_000
LONG_AGO_US = -(1 << 60)
# A right state is some such deviations from the forecast. One that is farther away is off by as much
# more than its covariance says: the motion was not what it was taken for, or the lines were not.
EXPECTED_SURPRISE = 1.5
# What a window explained counts less in every later one.
FADE = 0.8
# Another answer that explains this share of what the best one does is a rival.
RIVAL_SHARE = 0.9
MAX_FOLLOWER_COUNT = 3


class Follower:
    """A motion that began with a fit.

    Args:
        fit: the first one.
        before: what it explains counts so many times, in place of windows before it.

    Attributes:
        fit: the last window's.
        status: what the windows say of this answer alone.
        explained_count: events that it explained, the last ones above all.
    """

    def __init__(self, fit: WindowFit, before: float = 1.0) -> None:
        self.fit = fit
        self.status = PoseStatus.UNCERTAIN
        self.explained_count = before * fit.evidence.explained_count
        self._verdict = Verdict()
        self._cautious = fit.state.covariance
        self._seen_us = np.full(len(fit.seen), LONG_AGO_US)

    @property
    def state(self) -> MotionState:
        return self.fit.state

    @property
    def before(self) -> float:
        """How many times the last window counts in `explained_count`."""
        explained_count = self.fit.evidence.explained_count
        return self.explained_count / explained_count if explained_count else 1.0

    def begin_anew(self) -> None:
        """Take nothing that was said so far for a reason to rely on it."""
        self.status = PoseStatus.UNCERTAIN
        self._verdict = Verdict()

    def follow(self, window: Window, eyes: Eyes, config: TrackConfig) -> None:
        """Go on to the next window."""
        after_s = (window.t_us - self.state.t_us) * 1e-6
        is_unsure = not convinces(self.fit, config)
        forecast = self.state.foretold(window.t_us, config)
        scales_px = UNSURE_SCALES_PX if is_unsure else EVENT_SCALES_PX
        known = window.t_us - self._seen_us <= MEMORY_US
        fit = fit_window(forecast, window, eyes.pieces, eyes.view, config, scales_px, known)
        doubt = max(1.0, fit.surprise / EXPECTED_SURPRISE) ** 2
        self.fit = replace(fit, state=fit.state.stepped(np.zeros(12), doubt * fit.state.covariance))
        self._seen_us[self.fit.seen] = window.t_us
        cautious = cautious_covariance(faded(self._cautious, after_s, config), self.fit)
        self._cautious = doubt * cautious
        self.status = self._verdict.of(self.fit, self._cautious, config)
        self.explained_count *= FADE
        self.explained_count += self.fit.evidence.explained_count


def cautious_covariance(forecast: FloatArray, fit: WindowFit) -> FloatArray:
    """(12, 12) covariance of the state if the edge that it needs most is not what it seems.

    Args:
        forecast: (12, 12) the same before the window.
    """
    without = np.linalg.inv(forecast) + fit.information - fit.information_of_edges
    if len(without) == 0:
        return forecast
    covariances = np.linalg.inv(without)
    shift = np.linalg.eigvalsh(covariances[:, 3:6, 3:6])[:, -1]
    return np.asarray(covariances[np.argmax(shift)])


def rivals(followers: Sequence[Follower]) -> list[Follower]:
    """The best answer, and others that explain nearly as much."""
    kept: list[Follower] = []
    for follower in sorted(followers, key=lambda each: each.explained_count, reverse=True):
        if kept and follower.explained_count < RIVAL_SHARE * kept[0].explained_count:
            break
        if not any(is_same_pose(follower.state, other.state) for other in kept):
            kept.append(follower)
    return kept[:MAX_FOLLOWER_COUNT]
