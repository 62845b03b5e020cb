"""Local alignment: robust point-to-plane steps, the scale of the errors shrinking as they do.

Samples that move onto the cloud's surfaces are pulled along the normals there. A line on a crease has
samples on both of its planes, so that it is held across in both directions; nothing pulls along a
surface, where a point-to-point cost would hold a map to whichever points happen to be near.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.geometry.se3 import SE3, rotation_from_vector
from roel_service.geometry.vectors import any_normal, dot, norm
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
# Steps shorter than this, rad and m, are no steps.
SETTLED_STEP = 2e-5
# Pairs below which nothing can be solved.
MIN_PAIR_COUNT = 6
# One line's samples err together: they count as so many independent ones.
INDEPENDENT_PER_LINE = 2.0
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
    for step in range(1, level.step_count + 1):
        is_last_scale = scale_m <= level.last_scale_m
        moved = T @ (scale * some.points)
        directions = T.rotate(some.directions)
        equations = Equations(H=np.zeros((7, 7)), g=np.zeros(7), pivot=moved.mean(axis=0))
        pairs = _pull(equations, moved, directions, some.weights, target, scale_m, level)
        if pairs < MIN_PAIR_COUNT:
            return _ended(T, scale, StopReason.NO_OVERLAP, start, step)
        tangent, growth = equations.step(level.estimate_scale)
        pivot, rotation = equations.pivot, rotation_from_vector(tangent[:3])
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


@dataclass(eq=False, kw_only=True)
class Equations:
    """Normal equations of one step: rotation about a pivot, shift, growth.

    Attributes:
        H: (7, 7); g: (7,).
        pivot: (3,) m, what the samples turn about.
        squares_m2, weight: weighted sums of the squared distances, and of one.
    """

    H: FloatArray
    g: FloatArray
    pivot: FloatArray
    squares_m2: float = 0.0
    weight: float = 0.0

    def add(self, p: FloatArray, n: FloatArray, off_m: FloatArray, weights: FloatArray) -> None:
        """Samples at p that are off by `off_m` along n: (N, 3), (N, 3), (N,), and their weights."""
        arm = p - self.pivot
        J = np.concatenate([_cross(arm, n), n, dot(arm, n)[:, None]], axis=1)
        weighted = J * weights[:, None]
        self.H += weighted.T @ J
        self.g += weighted.T @ off_m
        self.squares_m2 += float(weights @ off_m**2)
        self.weight += float(weights.sum())

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
    level = Level(
        first_scale_m=0.0,
        last_scale_m=target.resolution_m,
        sample_count=len(samples),
        step_count=0,
        crease_weight=1.0,
    )
    # R <- Exp(r) R turns about the translation.
    equations = Equations(H=np.zeros((7, 7)), g=np.zeros(7), pivot=T.translation)
    directions = T.rotate(samples.directions)
    _pull(equations, moved, directions, weights, target, target.resolution_m, level)
    sigma2_m2 = equations.squares_m2 / max(equations.weight, 1e-9)
    return np.asarray(equations.H[:6, :6] / max(sigma2_m2, MIN_SIGMA_M**2))


def _pull(
    equations: Equations,
    moved: FloatArray,
    directions: FloatArray,
    weights: FloatArray,
    target: PreparedCloud,
    scale_m: float,
    level: Level,
) -> int:
    """Add the pairs of this moment; answers how many."""
    count = 0
    if level.surface_weight > 0.0:
        share = POINT_SHARE if scale_m > level.last_scale_m else 0.0
        weighted = level.surface_weight * weights
        count += _pull_to_surfaces(equations, moved, weighted, target, scale_m, share)
    if level.crease_weight > 0.0:
        weighted = level.crease_weight * weights
        reach_m = GATE_SCALES * scale_m
        if level.surface_weight > 0.0 and len(target.surface_points):
            # Surfaces bring lines near first, and more surely.
            reach_m = min(reach_m, CREASE_REACH * target.resolution_m)
        count += _pull_to_creases(equations, moved, directions, weighted, target, scale_m, reach_m)
    return count


def _pull_to_surfaces(
    equations: Equations,
    moved: FloatArray,
    weights: FloatArray,
    target: PreparedCloud,
    scale_m: float,
    point_share: float,
) -> int:
    """Add samples and the nearest surfaces, along the normals; answers how many."""
    distance_m, nearest = target.surface_tree.query(
        moved, distance_upper_bound=GATE_SCALES * scale_m, workers=-1
    )
    paired = np.isfinite(distance_m)
    p, nearest, weights = moved[paired], nearest[paired], weights[paired]
    n = target.surface_normals[nearest]
    off = p - target.surface_points[nearest]
    along_normal = dot(n, off)
    # While the scale is coarse the whole distance counts: far along a surface is far as well.
    size_m = norm(off) if point_share else along_normal
    weights = weights * _geman_mcclure(size_m, scale_m)
    equations.add(p, n, along_normal, weights)
    if point_share:
        for axis in np.eye(3):
            equations.add(p, np.broadcast_to(axis, p.shape), off @ axis, point_share * weights)
    return len(p)


def _pull_to_creases(
    equations: Equations,
    moved: FloatArray,
    directions: FloatArray,
    weights: FloatArray,
    target: PreparedCloud,
    scale_m: float,
    reach_m: float,
) -> int:
    """Add samples and the nearest creases that run their way, across; answers how many."""
    if target.crease_tree is None:
        return 0
    distance_m, near = target.crease_tree.query(moved, k=CREASE_COUNT, distance_upper_bound=reach_m)
    known = np.isfinite(distance_m)
    near = np.where(known, near, 0)
    u = target.creases.directions[near]
    off = moved[:, None] - target.creases.points[near]
    off = off - np.einsum("pkc,pkc->pk", off, u)[..., None] * u
    alike = np.abs(np.einsum("pkc,pc->pk", u, directions)) > CREASE_COSINE
    across_m = np.where(known & alike, norm(off), np.inf)
    best = across_m.argmin(axis=1)
    paired = np.flatnonzero(np.isfinite(across_m[np.arange(len(best)), best]))
    best = best[paired]
    u, off = u[paired, best], off[paired, best]
    weights = weights[paired] * _geman_mcclure(across_m[paired, best], scale_m)
    first = any_normal(u)
    for n in (first, _cross(u, first)):
        equations.add(moved[paired], n, dot(off, n), weights)
    return len(paired)


def _geman_mcclure(distance_m: FloatArray, scale_m: float) -> FloatArray:
    """Weights that fall to a quarter at the scale, and with the fourth power beyond."""
    return np.asarray((scale_m**2 / (scale_m**2 + distance_m**2)) ** 2)


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """(N, 3) cross products; numpy's own takes four times as long."""
    ax, ay, az = a.T
    bx, by, bz = b.T
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=1)
