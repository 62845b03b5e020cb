"""How well a transform fits, how firmly it is held, and whether it may be relied on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from roel_service.arrays import BoolArray, FloatArray
from roel_service.config.stages import RegisterConfig
from roel_service.geometry.se3 import SE3, rotation_angle, skew
from roel_service.register.align import information
from roel_service.register.alignment import Alignment
from roel_service.register.prepare import PreparedCloud
from roel_service.register.source import Samples, Source
from roel_service.scene.results import Alternative, RegistrationResult, StopReason, Verdict

# A direction held this much less firmly than the firmest one is weak.
WEAK_RATIO = 2e-3
# Samples this near to a surface or a crease, in distances between points, agree with it; lines and
# creases have to run alike (cosine).
SURFACE_REACH, CREASE_REACH, CREASE_COSINE = 1.5, 3.0, 0.96
# Creases near a sample that are looked at.
CREASE_COUNT = 3
# Of all that agrees, creases count more than surfaces: every room is full of surfaces.
CREASE_WEIGHT = 2.0
# Samples that are looked at.
JUDGED_COUNT = 3000
# Transforms closer than this are one and the same.
SAME_ROTATION_RAD, SAME_SHIFT_M = np.radians(3.0), 0.15


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """Shares of the samples that lie on surfaces, and on creases that run their way."""

    surface: float
    crease: float

    @property
    def score(self) -> float:
        """Both in one, 0 to 1."""
        return (self.surface + CREASE_WEIGHT * self.crease) / (1.0 + CREASE_WEIGHT)


def agreement(alignment: Alignment, source: Source, target: PreparedCloud, count: int) -> Agreement:
    """How well the source, moved, agrees with the target."""
    samples, votes = source.samples.at_most(count), source.votes.at_most(count)
    reach_m = SURFACE_REACH * target.resolution_m
    distance_m, _ = target.tree.query(_moved(alignment, samples), distance_upper_bound=reach_m)
    on_crease = _on_crease(alignment, votes, target) if len(votes) else np.zeros(1, np.bool_)
    return Agreement(surface=float(np.isfinite(distance_m).mean()), crease=float(on_crease.mean()))


def _on_crease(alignment: Alignment, votes: Samples, target: PreparedCloud) -> BoolArray:
    """(P,) whether a crease that runs along is near."""
    if target.crease_tree is None:
        return np.zeros(len(votes), np.bool_)
    reach_m = CREASE_REACH * target.resolution_m
    distance_m, near = target.crease_tree.query(
        _moved(alignment, votes), k=CREASE_COUNT, distance_upper_bound=reach_m
    )
    known = np.isfinite(distance_m)
    creases = target.creases.directions[np.where(known, near, 0)]
    lines = alignment.T_target_source.rotate(votes.directions)
    alike = np.abs(np.einsum("pkc,pc->pk", creases, lines)) > CREASE_COSINE
    return np.asarray((known & alike).any(axis=1))


def _moved(alignment: Alignment, samples: Samples) -> FloatArray:
    return alignment.T_target_source @ (alignment.scale * samples.points)


def is_same(a: SE3, b: SE3, centre: FloatArray) -> bool:
    """Whether two transforms put the source's middle at one place, turned alike."""
    turn_rad = float(rotation_angle(a.rotation @ b.rotation.T))
    shift_m = float(np.linalg.norm(a @ centre - b @ centre))
    return turn_rad < SAME_ROTATION_RAD and shift_m < SAME_SHIFT_M


@dataclass(frozen=True, eq=False, kw_only=True)
class Rival:
    """Where one guess ended, and how well it agrees there."""

    alignment: Alignment
    found: Agreement


def competing(
    alignments: list[Alignment],
    source: Source,
    target: PreparedCloud,
    config: RegisterConfig,
    count: int = JUDGED_COUNT,
) -> list[Rival]:
    """Those that agree about as well as the best, best first, each place once.

    Args:
        count: about so many samples are looked at.
    """
    rivals = [
        Rival(alignment=one, found=agreement(one, source, target, count)) for one in alignments
    ]
    rivals.sort(key=lambda rival: -rival.found.score)
    kept: list[Rival] = []
    for rival in rivals:
        if rival.found.score < config.ambiguity_ratio * rivals[0].found.score:
            break
        T = rival.alignment.T_target_source
        if not any(is_same(T, one.alignment.T_target_source, source.centre) for one in kept):
            kept.append(rival)
    return kept


def judge(
    alignments: list[Alignment], source: Source, target: PreparedCloud, config: RegisterConfig
) -> RegistrationResult:
    """The result of a method, with what it is worth.

    Args:
        alignments: where its guesses ended, in any order; at least one.
    """
    best, *others = competing(alignments, source, target, config)
    alignment, samples = best.alignment, source.samples
    moved = _moved(alignment, samples)
    distance_m = _distances_m(moved, target, config)
    near = np.isfinite(distance_m)
    held, weak = None, np.empty((0, 6))
    if near.any():
        held = information(alignment, samples, target)
        arm = moved.mean(axis=0) - alignment.T_target_source.translation
        weak = weak_directions(held, arm, _radius_m(moved))
    fitness, inside = float(near.mean()), inside_share(moved, target, config.max_distance_m)
    is_contested = bool(others) or len(weak) > 0
    return RegistrationResult(
        T_target_source=alignment.T_target_source,
        scale=alignment.scale,
        stop_reason=alignment.stop_reason if near.any() else StopReason.NO_OVERLAP,
        verdict=_verdict(inside, fitness, best.found.score, is_contested, config),
        inside=inside,
        fitness=fitness,
        overlap=overlap(moved, target),
        agreement=best.found.score,
        inlier_rmse_m=float(np.sqrt((distance_m[near] ** 2).mean())) if near.any() else None,
        information=held,
        weak_directions=weak,
        alternatives=tuple(_alternative(rival, samples, target, config) for rival in others),
        iteration_count=alignment.iteration_count,
    )


def _distances_m(moved: FloatArray, target: PreparedCloud, config: RegisterConfig) -> FloatArray:
    """(P,) to the nearest points of the target; infinite beyond the largest that fits."""
    return np.asarray(target.tree.query(moved, distance_upper_bound=config.max_distance_m)[0])


def _alternative(
    rival: Rival, samples: Samples, target: PreparedCloud, config: RegisterConfig
) -> Alternative:
    distance_m = _distances_m(_moved(rival.alignment, samples), target, config)
    return Alternative(
        T_target_source=rival.alignment.T_target_source,
        scale=rival.alignment.scale,
        fitness=float(np.isfinite(distance_m).mean()),
        score=rival.found.score,
    )


def overlap(moved: FloatArray, target: PreparedCloud) -> float:
    """Share of the target's creases inside the map's box that have a sample of the map near them.

    Surfaces do not count: between its lines a map says nothing of them.

    Args:
        moved: (P, 3) the map's samples in the target, m.
    """
    reach_m = CREASE_REACH * target.resolution_m
    creases = target.creases.points
    low, high = moved.min(axis=0) - reach_m, moved.max(axis=0) + reach_m
    inside = creases[((creases >= low) & (creases <= high)).all(axis=1)]
    if len(inside) == 0:
        return 0.0
    some = inside[:: -(-len(inside) // JUDGED_COUNT)]
    distance_m, _ = cKDTree(moved).query(some, distance_upper_bound=reach_m)
    return float(np.isfinite(distance_m).mean())


def inside_share(moved: FloatArray, target: PreparedCloud, reach_m: float) -> float:
    """Share of (P, 3) moved samples inside the target's box, or near it."""
    low, high = target.points.min(axis=0) - reach_m, target.points.max(axis=0) + reach_m
    return float(((moved >= low) & (moved <= high)).all(axis=1).mean())


def _verdict(
    inside: float, fitness: float, score: float, is_contested: bool, config: RegisterConfig
) -> Verdict:
    """What a transform is worth by its shares of all samples.

    A cloud says nothing of what lies outside its box, where nothing fits and nothing agrees. The less is
    inside, the easier it fits somewhere, so that fewer of those samples may be misfits.
    """
    if inside < config.min_inside:
        return Verdict.REJECTED
    max_misfit = (1.0 - config.min_fitness) * inside**2
    if fitness < (1.0 - max_misfit) * inside or score < config.min_agreement * inside:
        return Verdict.REJECTED
    return Verdict.AMBIGUOUS if is_contested else Verdict.ACCEPTED


def _radius_m(points: FloatArray) -> float:
    return float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))


def weak_directions(held: FloatArray, arm: FloatArray, radius_m: float) -> FloatArray:
    """(K, 6) unit tangents about the source's centre that the information hardly holds.

    Args:
        held: (6, 6) information of (r, d), target frame.
        arm: (3,) the centre of the moved source, seen from the translation.
        radius_m: what one radian moves a typical sample by, to compare turns with shifts.
    """
    # The centre moves by r x arm + d.
    from_scaled = np.eye(6)
    from_scaled[3:, :3] = skew(arm)
    from_scaled[:, :3] /= max(radius_m, 1e-9)
    values, vectors = np.linalg.eigh(from_scaled.T @ held @ from_scaled)
    return np.asarray(vectors[:, values < WEAK_RATIO * values[-1]].T)
