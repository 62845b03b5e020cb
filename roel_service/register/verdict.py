"""How well a transform fits, how firmly it is held, and whether it may be relied on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.config.stages import RegisterConfig
from roel_service.geometry.se3 import skew
from roel_service.register.alignment import Alignment
from roel_service.register.prepare import PreparedCloud
from roel_service.register.source import Samples
from roel_service.scene.results import RegistrationResult, StopReason, Verdict

# A direction held this much less firmly than the firmest one is weak.
WEAK_RATIO = 1e-3


@dataclass(frozen=True, kw_only=True)
class Closeness:
    """How near the source is to the target, and the other way round.

    Attributes:
        fitness: share of the source's samples with a target point near by.
        overlap: share of the target's points around the source with a sample near by.
        inlier_rmse_m: of the samples that count for `fitness`; None if none does.
    """

    fitness: float
    overlap: float
    inlier_rmse_m: float | None


def closeness(moved: FloatArray, target: PreparedCloud, max_distance_m: float) -> Closeness:
    """Compare the samples, moved into the target's frame, with the target."""
    distance_m, _ = target.tree.query(moved, distance_upper_bound=max_distance_m, workers=-1)
    near = distance_m <= max_distance_m
    rmse_m = float(np.sqrt((distance_m[near] ** 2).mean())) if near.any() else None
    return Closeness(fitness=float(near.mean()), overlap=0.0, inlier_rmse_m=rmse_m)


def information_of_points(moved: FloatArray, sigma_m: FloatArray) -> FloatArray:
    """(6, 6) of points whose three coordinates are known to `sigma_m`; tangent (r, d)."""
    # p moves by r x p + d.
    J = np.concatenate([-skew(moved), np.broadcast_to(np.eye(3), (len(moved), 3, 3))], axis=-1)
    J = J / sigma_m[:, None, None]
    return np.asarray(np.einsum("pij,pik->jk", J, J))


def weak_directions(information: FloatArray, centre: FloatArray, radius_m: float) -> FloatArray:
    """(K, 6) unit tangents about the source's centre that the information hardly holds.

    Args:
        information: (6, 6) of (r, d), target frame.
        centre: (3,) of the moved source; turning about it leaves the translation alone.
        radius_m: what one radian moves a typical sample by, to compare turns with shifts.
    """
    # d = d_centre - r x centre = d_centre + centre x r
    from_scaled = np.eye(6)
    from_scaled[3:, :3] = skew(centre)
    from_scaled[:, :3] /= radius_m
    values, vectors = np.linalg.eigh(from_scaled.T @ information @ from_scaled)
    return np.asarray(vectors[:, values < WEAK_RATIO * values[-1]].T)


def judge(
    alignment: Alignment, samples: Samples, target: PreparedCloud, config: RegisterConfig
) -> RegistrationResult:
    """The result of a method, with what it is worth."""
    T = alignment.T_target_source
    moved = T @ (alignment.scale * samples.points)
    close = closeness(moved, target, config.max_distance_m)
    information, weak = None, np.empty((0, 6))
    if close.inlier_rmse_m is not None:
        sigma_m = np.full(len(moved), max(close.inlier_rmse_m, 1e-3))
        information = information_of_points(moved, sigma_m)
        weak = weak_directions(information, moved.mean(axis=0), samples.radius_m)
    rejected = close.fitness < config.min_fitness
    verdict = Verdict.REJECTED if rejected else Verdict.ACCEPTED
    if len(weak) and not rejected:
        verdict = Verdict.AMBIGUOUS
    return RegistrationResult(
        T_target_source=T,
        scale=alignment.scale,
        stop_reason=StopReason.NO_OVERLAP if close.fitness == 0.0 else alignment.stop_reason,
        verdict=verdict,
        fitness=close.fitness,
        overlap=close.overlap,
        inlier_rmse_m=close.inlier_rmse_m,
        information=information,
        weak_directions=weak,
        iteration_count=alignment.iteration_count,
    )
