"""Whether a pose may be relied on: what the lines say, and how long they have been saying it."""

from __future__ import annotations

import numpy as np

from roel_service.config.stages import TrackConfig
from roel_service.scene.results import PoseStatus
from roel_service.tracking.fit import WindowFit

# Fewer pieces of lines that are seen do not hold a pose against chance.
MIN_SEEN_COUNT = 6
# So many windows in a row must agree before a pose that was found anew may be relied on, and so
# many must disagree before a pose is given up; one that hardly agrees at all is given up at once.
CONFIRMED_COUNT, DOUBTED_COUNT = 3, 3
HARDLY = 0.5
# A state this many deviations from the forecast is no continuation of the motion (12 unknowns).
MAX_SURPRISE = 8.0


def agrees(fit: WindowFit, config: TrackConfig) -> bool:
    """Whether events lie on the lines that must have some."""
    evidence = fit.evidence
    return (
        evidence.seen_count >= MIN_SEEN_COUNT
        and evidence.seen_share >= config.min_seen_share
        and evidence.sharpness >= config.min_sharpness
    )


class Verdict:
    """Follows the agreement of the windows since a pose was found."""

    def __init__(self) -> None:
        self._agreed_count = 0
        self._doubted_count = 0

    def of(self, fit: WindowFit, config: TrackConfig) -> PoseStatus:
        """The status of the next window's pose."""
        if agrees(fit, config):
            self._agreed_count += 1
            self._doubted_count = 0
        elif not fit.evidence.is_still:
            self._doubted_count += 1
        hardly = fit.evidence.seen_share < HARDLY * config.min_seen_share
        if self._doubted_count >= DOUBTED_COUNT or (self._doubted_count and hardly):
            return PoseStatus.LOST
        is_sure = (
            self._doubted_count == 0
            and self._agreed_count > CONFIRMED_COUNT
            and fit.surprise <= MAX_SURPRISE
            and _is_known(fit, config)
        )
        if fit.surprise > MAX_SURPRISE:
            self._agreed_count = 0
        return PoseStatus.TRACKING if is_sure else PoseStatus.UNCERTAIN


def _is_known(fit: WindowFit, config: TrackConfig) -> bool:
    covariance = fit.state.covariance
    turn = np.linalg.eigvalsh(covariance[:3, :3])[-1]
    shift = np.linalg.eigvalsh(covariance[3:6, 3:6])[-1]
    return bool(turn <= np.deg2rad(config.max_sigma_deg) ** 2 and shift <= config.max_sigma_m**2)
