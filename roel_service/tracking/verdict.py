"""Whether a pose may be relied on: what the lines say, and how long they have been saying it."""

from __future__ import annotations

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.config.stages import TrackConfig
from roel_service.scene.results import PoseStatus
from roel_service.tracking.fit import WindowFit

# Fewer pieces of lines that are seen do not hold a pose against chance.
MIN_SEEN_COUNT = 6
# Of what convinces, this share or less contradicts.
CONTRADICTING_SHARE = 0.3
# A pose that was found is doubted, not contradicted, by windows that have this share of what it needs
# to be found: where others hide some lines, a right pose is not far above that.
DOUBTING_SHARE = 0.75
# Of a pose that is known so many times worse than what may be relied on, nothing that convinces counts:
# what it narrows down to is an answer like one that was found just now.
WIDE = 3.0
# So many windows in a row must convince before a pose is relied on. It is given up when so many
# contradict, or when it has not convinced for so many.
CONVINCED_COUNT, CONTRADICTED_COUNT, PATIENCE_COUNT = 4, 3, 20
# A state this many deviations from the forecast is no continuation of the motion (12 unknowns).
MAX_SURPRISE = 8.0


def convinces(fit: WindowFit, config: TrackConfig) -> bool:
    """Whether events lie on the lines that must have some, and hardly any beside them."""
    return is_possible(fit, config) and fit.evidence.sharpness >= config.min_sharpness


def is_possible(fit: WindowFit, config: TrackConfig) -> bool:
    """Whether events lie on the lines that must have some."""
    return _lie_on_lines(fit, config.min_seen_share, config)


def _contradicts(fit: WindowFit, config: TrackConfig) -> bool:
    """Whether many lines that must have events have none."""
    return not _lie_on_lines(fit, DOUBTING_SHARE * config.min_seen_share, config)


def _lie_on_lines(fit: WindowFit, min_seen_share: float, config: TrackConfig) -> bool:
    evidence = fit.evidence
    return (
        evidence.seen_count >= MIN_SEEN_COUNT
        and evidence.seen_share >= min_seen_share
        and evidence.sharpness >= CONTRADICTING_SHARE * config.min_sharpness
    )


class Verdict:
    """Follows what the windows say since a pose was found."""

    def __init__(self) -> None:
        self._convinced_count = 0
        self._unconvinced_count = 0
        self._contradicted_count = 0

    def of(self, fit: WindowFit, cautious: FloatArray, config: TrackConfig) -> PoseStatus:
        """The status of the next window's pose.

        Args:
            cautious: (12, 12) covariance of the state if no edge is relied on alone.
        """
        self._count(fit, config)
        if not _is_known(cautious, config, WIDE):
            self._convinced_count = 0
        is_elsewhere = (
            self._contradicted_count > 0
            and fit.evidence.seen_share < CONTRADICTING_SHARE * config.min_seen_share
        )
        if (
            is_elsewhere
            or self._contradicted_count >= CONTRADICTED_COUNT
            or self._unconvinced_count >= PATIENCE_COUNT
        ):
            return PoseStatus.LOST
        is_sure = self._convinced_count >= CONVINCED_COUNT and _is_known(cautious, config)
        return PoseStatus.TRACKING if is_sure else PoseStatus.UNCERTAIN

    def _count(self, fit: WindowFit, config: TrackConfig) -> None:
        if fit.evidence.is_still:
            # Nothing for or against it.
            return
        if convinces(fit, config) and fit.surprise <= MAX_SURPRISE:
            self._convinced_count += 1
            self._unconvinced_count = self._contradicted_count = 0
            return
        self._convinced_count = 0
        self._unconvinced_count += 1
        self._contradicted_count = self._contradicted_count + 1 if _contradicts(fit, config) else 0


def _is_known(covariance: FloatArray, config: TrackConfig, times: float = 1.0) -> bool:
    turn = np.linalg.eigvalsh(covariance[:3, :3])[-1]
    shift = np.linalg.eigvalsh(covariance[3:6, 3:6])[-1]
    max_turn, max_shift = times * np.deg2rad(config.max_sigma_deg), times * config.max_sigma_m
    return bool(turn <= max_turn**2 and shift <= max_shift**2)
