"""Local alignment: robust point-to-plane steps, the scale of the errors shrinking as they do.

Samples that move onto the cloud's surfaces are pulled along the normals there. A line on a crease has
samples on both of its planes, so that it is held across in both directions; nothing pulls along a
surface, where a point-to-point cost would hold a map to whichever points happen to be near.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roel_service.arrays import FloatArray, IntArray
from roel_service.geometry.se3 import SE3, rotation_from_vector
from roel_service.geometry.vectors import dot, norm
from roel_service.register.align_kernels import crease_sums, surface_sums
from roel_service.register.alignment import Alignment
from roel_service.register.prepare import PreparedCloud
from roel_service.register.source import Samples
from roel_service.scene.results import StopReason

# Pairs farther apart than so many scales weigh next to nothing.
GATE_SCALES = 3.0
# While the scale is coarse a share of each pair also pulls along the surface, which widens the reach.
POINT_SHARE = 0.1
# Creases are looked for this near, in distances between points, and have to run alike (cosine).
CREASE_REACH, CREASE_COSINE, CREASE_COUNT = 1.5, 0.98, 3
# Samples are paired anew when one has moved by more than this, in scales of the loss.
REPAIR_SHARE = 0.25
# Steps shorter than this, rad and m, are no steps.
SETTLED_STEP = 2e-5
# Pairs below which nothing can be solved.
MIN_PAIR_COUNT = 6
# One line's samples err together, and lines share the errors of poses: so many count as independent ones.
INDEPENDENT_PER_LINE = 0.5
# No cloud and no map is better than this.
MIN_SIGMA_M = 1e-3
# Of the largest eigenvalue: what is held less firmly than that stays where it is.
DAMPING = 1e-7


@dataclass(frozen=True, kw_only=True)
class Level:
    """How one run of steps goes.

    Attributes:
        first_scale_m, last_scale_m: of the robust loss.
        sample_count: about so many samples are used.
        step_count: at most so many steps.
        scale_decay: the scale shrinks by this each step, down to the last one.
        estimate_scale: whether the source may grow.
        surface_weight, crease_weight: of what pulls to surfaces, and to creases.
    """

    first_scale_m: float
    last_scale_m: float
    sample_count: int
    step_count: int
    scale_decay: float = 0.7
    estimate_scale: bool = False
    surface_weight: float = 1.0
    crease_weight: float = 3.0


def align(samples: Samples, target: PreparedCloud, start: Alignment, level: Level) -> Alignment:
    """Step from a start until it settles."""
    some = samples.at_most(level.sample_count)
    T, scale = start.T_target_source, start.scale
    scale_m = level.first_scale_m
    pairs: Pairs | None = None
    for step in range(1, level.step_count + 1):
        is_last_scale = scale_m <= level.last_scale_m
        moved = T @ (scale * some.points)
        if pairs is None or pairs.motion_m(moved) > REPAIR_SHARE * scale_m:
            pairs = _paired(moved, T.rotate(some.directions), target, scale_m, level)
        if pairs.count < MIN_PAIR_COUNT:
            return _ended(T, scale, StopReason.NO_OVERLAP, start, step)
        pivot = moved.mean(axis=0)
        share = 0.0 if is_last_scale else POINT_SHARE
        equations = _equations(pairs, moved, some.weights, target, scale_m, share, level, pivot)
        tangent, growth = equations.step(level.estimate_scale)
        rotation = rotation_from_vector(tangent[:3])
        T = SE3(
            rotation=rotation @ T.rotation,
            translation=growth * (rotation @ (T.translation - pivot)) + pivot + tangent[3:],
        )
        scale *= growth
        if is_last_scale and np.abs(tangent).max() < SETTLED_STEP:
            return _ended(T, scale, StopReason.CONVERGED, start, step)
        scale_m = max(level.last_scale_m, level.scale_decay * scale_m)
    return _ended(T, scale, StopReason.ITERATION_LIMIT, start, level.step_count)


def _ended(T: SE3, scale: float, reason: StopReason, start: Alignment, steps: int) -> Alignment:
    count = steps + (start.iteration_count or 0)
    return Alignment(T_target_source=T, scale=scale, stop_reason=reason, iteration_count=count)


@dataclass(frozen=True, eq=False, kw_only=True)
class Pairs:
    """What each sample is pulled to; -1 for nothing.

    Attributes:
        moved: (P, 3) m, the samples when they were paired.
        surfaces: (P,) rows of the surface points.
        creases: (P,) rows of the creases.
    """

    moved: FloatArray
    surfaces: IntArray
    creases: IntArray

    @property
    def count(self) -> int:
        return int((self.surfaces >= 0).sum() + (self.creases >= 0).sum())

    def motion_m(self, moved: FloatArray) -> float:
        """How far any sample has moved since, along any axis."""
        return float(np.abs(moved - self.moved).max())


@dataclass(frozen=True, eq=False, kw_only=True)
class Equations:
    """Normal equations of one step: rotation about a pivot, shift, growth.

    Attributes:
        H: (7, 7); g: (7,).
        variance_m2: weighted mean of the squared distances.
    """

    H: FloatArray
    g: FloatArray
    variance_m2: float

    def step(self, estimate_scale: bool) -> tuple[FloatArray, float]:
        """(6,) tangent about the pivot, and the factor by which the source grows."""
        n = 7 if estimate_scale else 6
        values, vectors = np.linalg.eigh(self.H[:n, :n])
        values = np.maximum(values, DAMPING * values[-1])
        x = -vectors @ ((vectors.T @ self.g[:n]) / values)
        return x[:6], 1.0 + float(x[6]) if estimate_scale else 1.0


def information(alignment: Alignment, samples: Samples, target: PreparedCloud) -> FloatArray:
    """(6, 6) inverse covariance of (r, d) of a finished alignment, target frame.

    Samples are pulled along normals and across creases alone, so that what these leave open is open
    here. The samples of one line err together and count as a few independent ones.
    """
    T = alignment.T_target_source
    _, line, sizes = np.unique(samples.group, return_inverse=True, return_counts=True)
    weights = np.minimum(1.0, INDEPENDENT_PER_LINE / sizes[line])
    moved = T @ (alignment.scale * samples.points)
    scale_m = target.resolution_m
    level = Level(
        first_scale_m=scale_m,
        last_scale_m=scale_m,
        sample_count=len(samples),
        step_count=0,
        crease_weight=1.0,
    )
    pairs = _paired(moved, T.rotate(samples.directions), target, scale_m, level)
    # R <- Exp(r) R turns about the translation.
    equations = _equations(pairs, moved, weights, target, scale_m, 0.0, level, T.translation)
    return np.asarray(equations.H[:6, :6] / max(equations.variance_m2, MIN_SIGMA_M**2))


def _paired(
    moved: FloatArray,
    directions: FloatArray,
    target: PreparedCloud,
    scale_m: float,
    level: Level,
) -> Pairs:
    """The nearest surface of each sample, and the nearest crease that runs its way."""
    nothing = np.full(len(moved), -1)
    surfaces, creases, reach_m = nothing, nothing, GATE_SCALES * scale_m
    has_surfaces = level.surface_weight > 0.0 and len(target.surface_points) > 0
    if has_surfaces:
        _, rows = target.surface_tree.query(moved, distance_upper_bound=reach_m)
        surfaces = np.where(rows < len(target.surface_points), rows, -1)
        # Surfaces bring lines near first, and more surely.
        reach_m = min(reach_m, CREASE_REACH * target.resolution_m)
    if level.crease_weight > 0.0 and target.crease_tree is not None:
        creases = _creases_alike(moved, directions, target, reach_m)
    return Pairs(moved=moved, surfaces=surfaces, creases=creases)


def _creases_alike(
    moved: FloatArray, directions: FloatArray, target: PreparedCloud, reach_m: float
) -> IntArray:
    """(P,) of the creases near each sample the one that passes nearest and runs alike; -1 for none."""
    assert target.crease_tree is not None
    distance_m, near = target.crease_tree.query(moved, k=CREASE_COUNT, distance_upper_bound=reach_m)
    paired = np.flatnonzero(np.isfinite(distance_m[:, 0]))
    known = np.isfinite(distance_m[paired])
    near = np.where(known, near[paired], 0)
    u = target.creases.directions[near]
    off = moved[paired, None] - target.creases.points[near]
    off = off - dot(off, u)[..., None] * u
    alike = np.abs(dot(u, directions[paired, None])) > CREASE_COSINE
    across_m = np.where(known & alike, norm(off), np.inf)
    best = across_m.argmin(axis=1)
    each = np.arange(len(paired))
    rows = np.full(len(moved), -1)
    rows[paired] = np.where(np.isfinite(across_m[each, best]), near[each, best], -1)
    return rows


def _equations(
    pairs: Pairs,
    moved: FloatArray,
    weights: FloatArray,
    target: PreparedCloud,
    scale_m: float,
    point_share: float,
    level: Level,
    pivot: FloatArray,
) -> Equations:
    """The normal equations of all pairs where the samples are now."""
    to_surfaces, surface_weight = surface_sums(
        moved,
        level.surface_weight * weights,
        pairs.surfaces,
        target.surface_points,
        target.surface_normals,
        scale_m,
        point_share,
        pivot,
    )
    to_creases, crease_weight = crease_sums(
        moved,
        level.crease_weight * weights,
        pairs.creases,
        target.creases.points,
        target.creases.directions,
        scale_m,
        pivot,
    )
    upper = to_surfaces + to_creases
    sums = upper + np.triu(upper, 1).T
    total = max(surface_weight + crease_weight, 1e-9)
    return Equations(H=sums[:7, :7], g=sums[:7, 7], variance_m2=float(sums[7, 7]) / total)
