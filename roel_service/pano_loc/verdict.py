"""How well a pose fits in both directions, how firmly it is held, and whether to rely on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.config.stages import LocalizeConfig
from roel_service.geometry.se3 import SE3, rotation_angle
from roel_service.pano_loc.arcs import PanoramaArcs
from roel_service.pano_loc.coverage import (
    CROWD_REACH_RAD,
    GATE_RAD,
    covered,
    line_points,
    two_way_score,
)
from roel_service.pano_loc.prepare import PreparedMap
from roel_service.pano_loc.refine import (
    FINAL_GATE_RAD,
    FINAL_STEP_RAD,
    FINAL_WIDTHS_RAD,
    explained,
    sample_arcs,
)
from roel_service.pano_loc.refine_kernels import CUTOFF_WIDTHS, normal_equations
from roel_service.pano_loc.search import Candidates
from roel_service.pano_loc.side_by_side import side_by_side
from roel_service.pano_loc.sight_kernels import Pairs, Samples, Sight, match_rays, near, see
from roel_service.scene.results import (
    LocalizationStatus,
    NoPoseReason,
    PanoLocResult,
    PoseHypothesis,
)

# Fewer lines on either side hold no pose, whatever they are.
MIN_ARC_COUNT, MIN_ARC_TOTAL_RAD = 20, np.deg2rad(150.0)
# Photographs show less, and come with a prior.
MIN_PHOTO_ARC_COUNT, MIN_PHOTO_ARC_TOTAL_RAD = 10, np.deg2rad(60.0)
MIN_LINE_COUNT = 12
# Poses farther apart than either of these are different answers; `FOUND` promises the same.
SAME_ANSWER_M, SAME_ANSWER_RAD = 0.3, np.deg2rad(15.0)
# Along a direction that is less certain than this there is no answer.
MAX_SIGMA_M, MAX_SIGMA_RAD = 0.3, np.deg2rad(15.0)
POINT_SPACING_M = 0.1
# The best of many poses stands out by chance the farther, the fewer the arcs: a share of their scores
# varies with the root of their number.
CHANCE = 0.5
# With less beyond that a pose is told, but not as `FOUND`.
CERTAINTY = 0.06
# A pose that stands out needs less of a score: where walls hide most of a map, scores are low.
MARGIN_WEIGHT = 0.2
# What nothing holds gets a variance of 1, rad^2 or m^2.
WEAKEST = 1e-7
# What maps built from events are off as a whole, which no residual shows.
FLOOR_RAD, FLOOR_M = np.deg2rad(0.025), 8e-4

# Residuals of an exact map; and what maps add to them, at which the covariance doubles.
DETECTOR_RMS_RAD, MAP_RMS_RAD = np.deg2rad(0.22), np.deg2rad(0.25)


@dataclass(frozen=True, eq=False, kw_only=True)
class Found:
    """What the search brought out of one map.

    Attributes:
        hypotheses: in no order.
        rotation_count, candidate_count: orientations and poses that were tried.
    """

    hypotheses: tuple[PoseHypothesis, ...]
    rotation_count: int
    candidate_count: int


def enough_arcs(arcs: PanoramaArcs) -> bool:
    """Whether a picture has the lines that an answer needs."""
    count, total_rad = MIN_ARC_COUNT, MIN_ARC_TOTAL_RAD
    if len(arcs.sides):
        count, total_rad = MIN_PHOTO_ARC_COUNT, MIN_PHOTO_ARC_TOTAL_RAD
    return len(arcs) >= count and bool(arcs.length_rad.sum() >= total_rad)


def enough_lines(prepared: PreparedMap) -> bool:
    """Whether a map has."""
    return len(prepared) >= MIN_LINE_COUNT and len(prepared.places) > 0


def hypotheses(
    candidates: Candidates, arcs: PanoramaArcs, prepared: PreparedMap, map_index: int
) -> tuple[PoseHypothesis, ...]:
    """The candidates, weighed in both directions."""
    samples = sample_arcs(arcs, FINAL_STEP_RAD)
    lines = line_points(prepared.segments, POINT_SPACING_M)

    def weighed(index: int) -> PoseHypothesis:
        pose = candidates.poses[index]
        explained_2d, covariance = _explained(pose, samples, prepared.segments)
        explained_3d = covered(pose, samples, arcs.sides, lines)
        return PoseHypothesis(
            T_world_panorama=pose,
            score=two_way_score(explained_2d, explained_3d),
            covariance=covariance,
            explained_2d=explained_2d,
            explained_3d=explained_3d,
            map_index=map_index,
        )

    return tuple(side_by_side(weighed, range(len(candidates))))


def judge(searched: Sequence[Found], arcs: PanoramaArcs, config: LocalizeConfig) -> PanoLocResult:
    """The best poses of all maps, and the status of the best.

    Args:
        searched: one for each map that was searched; none if picture or maps had too few lines.
    """
    found = [item for one in searched for item in one.hypotheses]
    found = sorted(found, key=lambda item: -item.score)[: config.max_hypothesis_count]
    margin = _margin(found) if found else 0.0
    if not searched:
        reason: NoPoseReason | None = NoPoseReason.INSUFFICIENT_LINES
    elif not found:
        tried = any(one.candidate_count for one in searched)
        reason = NoPoseReason.NOT_IN_MAP if tried else NoPoseReason.DEGENERATE
    else:
        min_evidence = config.min_score + CHANCE / np.sqrt(len(arcs))
        reason = _reason(found[0], margin, min_evidence, config)
    status = {
        None: LocalizationStatus.FOUND,
        NoPoseReason.AMBIGUOUS: LocalizationStatus.AMBIGUOUS,
    }.get(reason, LocalizationStatus.NOT_FOUND)
    return PanoLocResult(
        status=status,
        reason=reason,
        hypotheses=() if status is LocalizationStatus.NOT_FOUND else tuple(found),
        score=found[0].score if found else 0.0,
        margin=margin,
        arc_count=len(arcs),
        rotation_count=sum(one.rotation_count for one in searched),
        candidate_count=sum(one.candidate_count for one in searched),
    )


def _reason(
    best: PoseHypothesis, margin: float, min_evidence: float, config: LocalizeConfig
) -> NoPoseReason | None:
    """Why the best pose may not be relied on; None if it may."""
    sigma = np.sqrt(np.linalg.eigvalsh(best.covariance[:3, :3])[-1])
    sigma_m = np.sqrt(np.linalg.eigvalsh(best.covariance[3:, 3:])[-1])
    # Without another pose nothing says that this one stands out.
    evidence = best.score + (MARGIN_WEIGHT * margin if margin < 1.0 else 0.0)
    if evidence < min_evidence or best.explained_3d < config.min_coverage:
        return NoPoseReason.NOT_IN_MAP
    if sigma > MAX_SIGMA_RAD or sigma_m > MAX_SIGMA_M:
        return NoPoseReason.DEGENERATE
    if margin < config.min_margin or evidence < min_evidence + CERTAINTY:
        return NoPoseReason.AMBIGUOUS
    return None


def _margin(found: list[PoseHypothesis]) -> float:
    """1 without a pose that would be another answer."""
    best = found[0]
    others = [item.score for item in found[1:] if not is_same_answer(best, item)]
    return 1.0 - max(others, default=0.0) / max(best.score, 1e-9)


def is_same_answer(a: PoseHypothesis, b: PoseHypothesis) -> bool:
    """Whether two poses are within what `FOUND` promises; places in different maps never are."""
    if a.map_index != b.map_index:
        return False
    T_a, T_b = a.T_world_panorama, b.T_world_panorama
    turn_rad = rotation_angle(T_a.rotation @ T_b.rotation.T)
    shift_m = np.linalg.norm(T_a.translation - T_b.translation)
    return bool(turn_rad <= SAME_ANSWER_RAD and shift_m <= SAME_ANSWER_M)


def _explained(pose: SE3, samples: Samples, segments: FloatArray) -> tuple[float, FloatArray]:
    """Share of the picture that (L, 2, 3) segments explain, and the (6, 6) covariance."""
    sight = see(segments, pose.rotation, pose.translation)
    pairs = near(sight, samples, GATE_RAD, CROWD_REACH_RAD, 0.0)
    line, residual, crowd = match_rays(sight, samples, pairs, GATE_RAD, CROWD_REACH_RAD)
    off = np.where(line >= 0, np.abs(residual), np.inf)
    inside = _covariance(sight, samples, pairs)
    turn = np.kron(np.eye(2), pose.rotation)
    return explained(samples, off, crowd), turn @ inside @ turn.T


def _covariance(sight: Sight, samples: Samples, pairs: Pairs) -> FloatArray:
    """(6, 6) of (r, d) in the picture's frame: what the residuals say about each other's pull.

    All samples of a line err together, and lines err independently. Where residuals are larger than
    those of the detector, the map is off, and that lines share: see `_inflation`.
    """
    width_rad = FINAL_WIDTHS_RAD[-1]
    cutoff_rad = CUTOFF_WIDTHS * width_rad
    line, residual, _ = match_rays(sight, samples, pairs, FINAL_GATE_RAD, cutoff_rad)
    H, gradients = normal_equations(sight, samples, line, residual, width_rad)
    inverse = np.linalg.inv(H + WEAKEST * np.eye(6))
    pull = gradients.T @ gradients
    line_count = int(np.count_nonzero(gradients.any(axis=1)))
    few = line_count / max(line_count - 6, 1)
    floor = np.diag([FLOOR_RAD**2] * 3 + [FLOOR_M**2] * 3)
    used = line >= 0
    mean_square = samples.weight[used] @ residual[used] ** 2
    mean_square /= max(samples.weight[used].sum(), 1e-9)
    sandwich = few * inverse @ pull @ inverse + floor
    covariance = _inflation(float(mean_square)) * sandwich + WEAKEST * inverse
    return np.asarray((covariance + covariance.T) / 2)


def _inflation(mean_square: float) -> float:
    """Factor of the covariance, from the mean square of the residuals, rad^2.

    Found by experiment: maps of simulated rooms, and few of their lines with noise of 3 cm.
    """
    excess = max(mean_square - DETECTOR_RMS_RAD**2, 0.0)
    return 1.0 + float((excess / MAP_RMS_RAD**2) ** 2.5)
