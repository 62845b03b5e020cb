"""Least squares over all observations and events of each line.

Paper: "Multi-view Line Optimization", with the poses held fixed. Lines then do not share any
unknown but the scale of the robust loss, and all of them are solved together as a batch of systems
of four: damped Gauss-Newton in the orthonormal parameterisation, about an own origin for each line
(the mean of its cameras), where the moment's length is the viewing distance and far from zero.

Three costs, see `RefineRoundsConfig.residual`:

- `pixel`: line and event term are quadratic forms y^T G y / |m_c|^2 of the Pluecker coordinates
  y = (v, m), in squared pixels (`moments`), with a robust weight an observation.
- `grassmann`: the published plane-to-line residual (n.v, d/sqrt(1 + d^2)) weighted by the 2D
  length, plus lambda times the sum over the events.
- `reprojection`: LIMAP's, the distances of the observed ends from the line's image in pixels, and
  the event term of `pixel`.

With the loss `quartic` every term e of a cost counts as e^2; the events of one observation together
as n times their mean e, squared.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from roel_service.arrays import Array, BoolArray, FloatArray
from roel_service.config.stages import RefineRoundsConfig
from roel_service.geometry import grassmann, plucker, reprojection
from roel_service.geometry.se3 import SE3
from roel_service.geometry.vectors import dot, norm
from roel_service.in_order import in_order
from roel_service.mapping import refine_kernels
from roel_service.mapping.evidence import Evidence
from roel_service.mapping.frames import Frames
from roel_service.mapping.line_parts import PART_COUNT, LinePart, line_parts
from roel_service.mapping.views import Views, cuts_m
from roel_service.scene.lines import InfiniteLines, LineTracks

# Damping relative to the diagonal: start, and factors after a good and a bad step.
FIRST_DAMPING = 1e-6
DAMPING_AFTER_SUCCESS = 0.3
DAMPING_AFTER_FAILURE = 30.0
# No step turns a line by more than this.
MAX_TURN_RAD = 0.2
# In the first steps outliers may lie this much farther out than later.
FIRST_GATE = 1.5
LOOSE_ITERATION_COUNT = 2
# A line rests once a step lowers its cost by no more than this share: far less than it is uncertain.
RESTING_SHARE = 1e-6
# Information that no observation gives, as a share of the whole: above float64's rounding, so that
# what nothing tells is very uncertain, not certain.
LEAST_INFORMATION = 1e-14
# Keeps the 4x4 systems of lines regular that no observation holds in some direction.
RIDGE = 1e-12


@dataclass(frozen=True, eq=False, kw_only=True)
class Refined:
    """Lines after refinement.

    Attributes:
        lines: L lines, world.
        tracks: the inliers of each line.
        rms_px: (L,) root mean square of the inliers' larger end residual.
        origin: (L, 3) m, world, about which each line was solved.
        information: (L, 4, 4) Hessian of the `pixel` cost, whichever was minimised, in the
            orthonormal tangent about the origin; 1/px^2.
        diverged: (L,) fewer inliers than needed, or no finite solution.
    """

    lines: InfiniteLines
    tracks: LineTracks
    rms_px: FloatArray
    origin: FloatArray
    information: FloatArray
    diverged: BoolArray

    def __len__(self) -> int:
        return len(self.lines)

    @staticmethod
    def joined(parts: Sequence[Refined]) -> Refined:
        """The lines of all parts, at least one, in order."""
        sizes = np.concatenate([part.tracks.sizes for part in parts])
        observation = np.concatenate([part.tracks.observation for part in parts])
        return Refined(
            lines=InfiniteLines(
                direction=np.concatenate([part.lines.direction for part in parts]),
                moment=np.concatenate([part.lines.moment for part in parts]),
            ),
            tracks=LineTracks(
                offsets=np.concatenate([[0], np.cumsum(sizes)]), observation=observation
            ),
            rms_px=np.concatenate([part.rms_px for part in parts]),
            origin=np.concatenate([part.origin for part in parts]),
            information=np.concatenate([part.information for part in parts]),
            diverged=np.concatenate([part.diverged for part in parts]),
        )

    def take(self, lines: Array) -> Refined:
        """The lines of these indices, or of this mask, in that order."""
        return Refined(
            lines=self.lines.take(lines),
            tracks=self.tracks.take(lines),
            rms_px=self.rms_px[lines],
            origin=self.origin[lines],
            information=self.information[lines],
            diverged=self.diverged[lines],
        )

    @property
    def covariance(self) -> FloatArray:
        """(L, 4, 4) in the orthonormal tangent about the origin, for 1 px of noise.

        The noise is that of an observation as a whole; measured errors are smaller.
        """
        whole = np.trace(self.information, axis1=-2, axis2=-1)[:, None, None]
        return np.linalg.inv(self.information + LEAST_INFORMATION * whole * np.eye(4))

    def jacobians(self) -> tuple[FloatArray, FloatArray]:
        """(L, 3, 4) derivatives of direction, and of the moment about the origin, by the tangent."""
        moment = plucker.shift_origin(self.lines.direction, self.lines.moment, self.origin)
        return plucker.plucker_jacobians(
            *plucker.orthonormal_from_plucker(self.lines.direction, moment)
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class DirectionPrior:
    """Directions that lines are pulled to.

    Attributes:
        direction: (L, 3) unit vectors, world; any where the weight is 0.
        weight: (L,) px^2/rad^2, of the squared sine between line and direction.
    """

    direction: FloatArray
    weight: FloatArray

    def part(self, lines: slice) -> DirectionPrior:
        """Of some of the lines."""
        return DirectionPrior(direction=self.direction[lines], weight=self.weight[lines])


@dataclass(frozen=True, eq=False, kw_only=True)
class PointPrior:
    """Points that lines are pulled to.

    Attributes:
        point: (L, 3) m, world; any where the weight is 0.
        weight: (L,) px^2/m^2, of the squared distance between line and point.
    """

    point: FloatArray
    weight: FloatArray

    def part(self, lines: slice) -> PointPrior:
        """Of some of the lines."""
        return PointPrior(point=self.point[lines], weight=self.weight[lines])


@dataclass(frozen=True, eq=False, kw_only=True)
class OrthonormalLines:
    """Orthonormal lines about their own origins: U (L, 3, 3), phi (L,)."""

    U: FloatArray
    phi: FloatArray

    @property
    def plucker(self) -> tuple[FloatArray, FloatArray]:
        return plucker.plucker_from_orthonormal(self.U, self.phi)


@dataclass(frozen=True, eq=False, kw_only=True)
class NormalEquations:
    """Normal equations of all lines: cost (L,), gradient (L, 4), Hessian (L, 4, 4)."""

    cost: FloatArray
    gradient: FloatArray
    hessian: FloatArray

    def __add__(self, other: NormalEquations) -> NormalEquations:
        return NormalEquations(
            cost=self.cost + other.cost,
            gradient=self.gradient + other.gradient,
            hessian=self.hessian + other.hessian,
        )


class _Problem:
    """The observations of all lines in one list, each row with its line."""

    def __init__(
        self,
        lines: InfiniteLines,
        tracks: LineTracks,
        evidence: Evidence,
        frames: Frames,
        config: RefineRoundsConfig,
        prior: DirectionPrior | None = None,
        corners: PointPrior | None = None,
    ) -> None:
        self.config = config
        self.prior = prior
        self.quartic = config.loss == "quartic"
        self.K = frames.K
        self.focal_px = frames.focal_px
        self.offsets = tracks.offsets
        self.line = tracks.track_of_row
        self.observation = tracks.observation
        self.evidence = evidence
        self.rotation = frames.T_world_camera.rotation
        centre = evidence.views.centre[self.observation]
        self.origin = self.mean(centre)
        self.corners = corners and replace(corners, point=corners.point - self.origin)
        # (S, 3) about the origin of each row's line.
        self.centre = centre - self.origin[self.line]
        self.end_rays = evidence.views.end_rays.take(self.observation, axis=0)
        length_px = evidence.views.length_px[self.observation]
        length = np.minimum(length_px, config.max_length_weight_px)
        if config.residual == "grassmann":
            # As published: the length in pixels, and lambda for each event.
            self.weight = length
            self.form_weight = config.event_weight * evidence.event_counts[tracks.observation]
            form_weights = 0.0, 1.0
        else:
            self.weight = length / config.max_length_weight_px
            self.form_weight = self.weight
            px2 = self.focal_px**2
            of_segments = px2 if config.residual == "pixel" else 0.0
            form_weights = of_segments, px2 * config.event_weight
        self.forms = refine_kernels.world_forms(
            self.centre,
            self.rotation,
            evidence.views.frame,
            self.observation,
            evidence.segment_forms,
            evidence.event_forms,
            *form_weights,
        )

    @cached_property
    def views(self) -> Views:
        """(S) as seen about the origin of each row's line."""
        return replace(self.evidence.views.take(self.observation), centre=self.centre)

    def total(self, rows: FloatArray) -> FloatArray:
        """(L, ...) sums of (S, ...) rows over each line."""
        padded = np.concatenate([rows, np.zeros((1, *rows.shape[1:]))])
        sums = np.add.reduceat(padded, self.offsets[:-1], axis=0)
        sums[np.diff(self.offsets) == 0] = 0.0
        return np.asarray(sums, dtype=np.float64)

    def mean(self, rows: FloatArray) -> FloatArray:
        """(L, ...) means of (S, ...) rows over each line; 0 for a line without rows."""
        counts = np.maximum(np.diff(self.offsets), 1)
        return self.total(rows) / counts.reshape(-1, *[1] * (rows.ndim - 1))

    def residual_px(self, state: OrthonormalLines) -> FloatArray:
        """(S,) larger end residual of each observation, px."""
        v, m = state.plucker
        return np.asarray(
            refine_kernels.end_residuals(
                self.offsets, v, m, self.centre, self.end_rays, self.focal_px
            )
        )

    def inliers(self, residual_px: FloatArray, *, loose: bool) -> BoolArray:
        """(S,) observations within the gate, which is wider in the first steps."""
        widening = FIRST_GATE if loose else 1.0
        return np.asarray(residual_px < widening * self.config.max_residual_px)

    def robust_weight(self, state: OrthonormalLines, residual_px: FloatArray) -> FloatArray:
        """(S,) weights of iterated reweighting."""
        if self.config.loss != "cauchy":
            return np.ones_like(residual_px)
        if self.config.residual == "reprojection":
            residual_px = norm(self._end_distances_px(state))
        return np.asarray(1.0 / (1.0 + (residual_px / self._loss_scale_px(residual_px)) ** 2))

    def _loss_scale_px(self, residual_px: FloatArray) -> float:
        """Where the loss bends: it follows the residuals of a recording worse than expected."""
        if self.config.loss_scale_medians == 0.0:
            return self.config.loss_scale_px
        inlier_px = residual_px[self.inliers(residual_px, loose=False)]
        median_px = float(np.median(inlier_px)) if inlier_px.size else 0.0
        return max(self.config.loss_scale_px, self.config.loss_scale_medians * median_px)

    def cost(self, state: OrthonormalLines, weight: FloatArray) -> FloatArray:
        """(L,) with fixed (S,) robust weights."""
        cost = self._form_cost(state, weight * self.form_weight)
        if self.config.residual != "pixel":
            cost = cost + self._line_system(state, weight * self.weight).cost
        if self.prior is not None:
            cost = cost + direction_cost(state, self.prior)
        if self.corners is not None:
            cost = cost + _point_system(state, self.corners).cost
        return cost

    def system(self, state: OrthonormalLines, weight: FloatArray) -> NormalEquations:
        """Cost, gradient and Gauss-Newton Hessian with fixed (S,) robust weights."""
        system = self._form_system(state, weight * self.form_weight)
        if self.config.residual != "pixel":
            system = system + self._line_system(state, weight * self.weight)
        if self.prior is not None:
            system = system + direction_system(state, self.prior)
        if self.corners is not None:
            system = system + _point_system(state, self.corners)
        return system

    def _form_cost(self, state: OrthonormalLines, weight: FloatArray) -> FloatArray:
        """(L,) sum w e with e = y^T G y / |m_c|^2, or w e^2."""
        v, m = state.plucker
        cost = refine_kernels.form_cost(
            self.offsets, v, m, self.centre, self.forms, weight, self.quartic
        )
        return np.asarray(cost)

    def _form_system(self, state: OrthonormalLines, weight: FloatArray) -> NormalEquations:
        """Of sum w e with e = y^T G y / |m_c|^2, y the line in each camera's frame, or w e^2."""
        v, m = state.plucker
        dv, dm = plucker.plucker_jacobians(state.U, state.phi)
        cost, gradient, hessian = refine_kernels.form_system(
            self.offsets,
            v,
            m,
            np.concatenate([dv, dm], axis=-2),
            self.centre,
            self.forms,
            weight,
            self.quartic,
        )
        return NormalEquations(cost=cost, gradient=gradient, hessian=hessian)

    def _line_system(self, state: OrthonormalLines, weight: FloatArray) -> NormalEquations:
        """Of the line term where it is not among the forms: sum w |r|^2, or w |r|^4."""
        if self.config.residual == "grassmann":
            r, J = self._plane_residuals(state)
        else:
            r, J = self._end_residuals(state)
        squared = dot(r, r)
        slope = np.einsum("sij,si->sj", J, r)
        hessian = np.swapaxes(J, -1, -2) @ (weight[:, None, None] * J)
        if not self.quartic:
            return NormalEquations(
                cost=self.total(weight * squared),
                gradient=self.total(weight[:, None] * slope),
                hessian=self.total(hessian),
            )
        bent = weight[:, None, None] * slope[:, :, None] * slope[:, None, :]
        return NormalEquations(
            cost=self.total(weight * squared**2),
            gradient=self.total((2.0 * weight * squared)[:, None] * slope),
            hessian=self.total(2.0 * squared[:, None, None] * hessian + 4.0 * bent),
        )

    def _plane_residuals(self, state: OrthonormalLines) -> tuple[FloatArray, FloatArray]:
        """(S, 2) values (n.v, d / sqrt(1 + d^2)) at the middles of the observed intervals.

        Also their (S, 2, 4) derivatives.
        """
        v, m = state.plucker
        along = self._middles_m(state)[self.line]
        foot = plucker.nearest_to_origin(v, m)[self.line] + along[:, None] * v[self.line]
        r = grassmann.plane_line_residual(self.views.normal, self.views.centre, v[self.line], foot)
        by_line, _ = grassmann.plane_line_jacobians(
            self.views.normal, self.views.centre, state.U[self.line], state.phi[self.line], along
        )
        return r, by_line

    def _end_residuals(self, state: OrthonormalLines) -> tuple[FloatArray, FloatArray]:
        """(S, 2) signed distances of the observed ends, px, and their (S, 2, 4) derivatives."""
        by_line, _ = reprojection.end_line_jacobians(
            self.views.segment_px,
            self._cameras,
            state.U[self.line],
            state.phi[self.line],
            self.K,
        )
        return self._end_distances_px(state), by_line

    def _end_distances_px(self, state: OrthonormalLines) -> FloatArray:
        """(S, 2) signed distances of the observed ends from the images of their lines, px."""
        v, m = state.plucker
        return reprojection.end_line_distances_px(
            self.views.segment_px, self._cameras, v[self.line], m[self.line], self.K
        )

    @property
    def _cameras(self) -> SE3:
        """(S) T_world_camera about the origin of each row's line."""
        return SE3(rotation=self.rotation[self.views.frame], translation=self.views.centre)

    def _middles_m(self, state: OrthonormalLines) -> FloatArray:
        """(L,) mean arc length of the middles of the observed intervals that cut the line."""
        v, m = state.plucker
        cuts, _ = cuts_m(self.views, v[self.line], m[self.line])
        middles = cuts.mean(axis=-1)
        counts = self.total(np.isfinite(middles).astype(np.float64))
        return self.total(np.nan_to_num(middles)) / np.maximum(counts, 1.0)


def direction_system(state: OrthonormalLines, prior: DirectionPrior) -> NormalEquations:
    """Of sum w |v x d|^2, the squared sine between line and direction."""
    cost, gradient, hessian = refine_kernels.direction_system(
        state.U, prior.direction, prior.weight
    )
    return NormalEquations(cost=cost, gradient=gradient, hessian=hessian)


def direction_cost(state: OrthonormalLines, prior: DirectionPrior) -> FloatArray:
    """(L,) that of `direction_system`."""
    return np.asarray(
        refine_kernels.direction_cost(state.U[:, :, 0], prior.direction, prior.weight)
    )


def _point_system(state: OrthonormalLines, prior: PointPrior) -> NormalEquations:
    """Of sum w |p x v - m|^2, the squared distance between line and point; all about one origin."""
    v, m = state.plucker
    dv, dm = plucker.plucker_jacobians(state.U, state.phi)
    r = np.cross(prior.point, v) - m
    J = np.cross(prior.point[..., None], dv, axisa=-2, axisb=-2, axisc=-2) - dm
    return NormalEquations(
        cost=prior.weight * dot(r, r),
        gradient=prior.weight[:, None] * np.einsum("lij,li->lj", J, r),
        hessian=prior.weight[:, None, None] * np.swapaxes(J, -1, -2) @ J,
    )


def refine_lines(
    lines: InfiniteLines,
    tracks: LineTracks,
    evidence: Evidence,
    frames: Frames,
    config: RefineRoundsConfig,
    prior: DirectionPrior | None = None,
    corners: PointPrior | None = None,
    *,
    worker_count: int = 1,
) -> Refined:
    """Refine every line over its observations; the poses stay as they are.

    Args:
        lines: L first estimates, world.
        tracks: the observations of each line.
        evidence: of all observations.
        frames: poses and calibration.
        config: cost, loss, gates and number of steps.
        prior: directions that lines are held to, see `directions`.
        corners: points that lines are held to, see `corners`.
        worker_count: threads; the answer is the same with any.
    """
    # A loss that follows the residuals of all lines has to see all.
    part_count = PART_COUNT if config.loss_scale_medians == 0.0 else 1

    def refined(part: LinePart) -> Refined:
        return _refined_part(
            lines.take(part.lines),
            LineTracks(offsets=part.offsets, observation=tracks.observation[part.rows]),
            evidence,
            frames,
            config,
            prior and prior.part(part.lines),
            corners and corners.part(part.lines),
        )

    parts = line_parts(tracks.offsets, part_count)
    return Refined.joined(list(in_order(refined, parts, worker_count)))


def _refined_part(
    lines: InfiniteLines,
    tracks: LineTracks,
    evidence: Evidence,
    frames: Frames,
    config: RefineRoundsConfig,
    prior: DirectionPrior | None,
    corners: PointPrior | None,
) -> Refined:
    problem = _Problem(lines, tracks, evidence, frames, config, prior, corners)
    moment = plucker.shift_origin(lines.direction, lines.moment, problem.origin)
    U, phi = plucker.orthonormal_from_plucker(lines.direction, moment)
    state = OrthonormalLines(U=U, phi=phi)
    damping = np.full(len(lines), FIRST_DAMPING)
    moves = np.ones(len(lines), dtype=bool)
    for iteration in range(config.iteration_count):
        is_loose = iteration < LOOSE_ITERATION_COUNT
        residual_px = problem.residual_px(state)
        inlier = problem.inliers(residual_px, loose=is_loose)
        # Rows of lines that rest cost nothing.
        inlier &= moves[problem.line]
        weight = problem.robust_weight(state, residual_px) * inlier
        state, damping, can_rest = _step(problem, state, weight, damping, moves)
        if not is_loose:
            moves &= ~can_rest
    residual_px = problem.residual_px(state)
    inlier = problem.inliers(residual_px, loose=False)
    weight = problem.robust_weight(state, residual_px) * inlier
    in_pixels = problem
    if config.residual != "pixel" or problem.quartic:
        metric = replace(config, residual="pixel", loss="squared", event_weight=1.0)
        in_pixels = _Problem(lines, tracks, evidence, frames, metric, prior, corners)
    information = in_pixels.system(state, weight).hessian
    return _refined(problem, tracks, state, residual_px, inlier, information)


def _step(
    problem: _Problem,
    state: OrthonormalLines,
    weight: FloatArray,
    damping: FloatArray,
    moves: BoolArray,
) -> tuple[OrthonormalLines, FloatArray, BoolArray]:
    """One damped step of the lines that move; one whose cost would grow stays and is damped more.

    Returns:
        The lines, their damping, and (L,) which of them have next to nothing to gain.
    """
    system = problem.system(state, weight)
    diagonal = np.einsum("lii->li", system.hessian)
    damped = system.hessian + np.einsum(
        "li,ij->lij", damping[:, None] * diagonal + RIDGE, np.eye(4)
    )
    delta = -np.linalg.solve(damped, system.gradient[..., None])[..., 0]
    gain = -dot(delta, system.gradient)
    turn = np.linalg.norm(delta[:, :3], axis=1)
    delta *= np.minimum(1.0, MAX_TURN_RAD / np.maximum(turn, MAX_TURN_RAD))[:, None]
    U, phi = plucker.retract_orthonormal(state.U, state.phi, delta)
    trial = OrthonormalLines(U=U, phi=phi)
    better = moves & (problem.cost(trial, weight) <= system.cost)
    return (
        OrthonormalLines(
            U=np.where(better[:, None, None], trial.U, state.U),
            phi=np.where(better, trial.phi, state.phi),
        ),
        damping * np.where(better, DAMPING_AFTER_SUCCESS, DAMPING_AFTER_FAILURE),
        better & (gain <= RESTING_SHARE * system.cost),
    )


def _refined(
    problem: _Problem,
    tracks: LineTracks,
    state: OrthonormalLines,
    residual_px: FloatArray,
    inlier: BoolArray,
    information: FloatArray,
) -> Refined:
    direction, moment = state.plucker
    moment = plucker.shift_origin(direction, moment, -problem.origin)
    counts = problem.total(inlier.astype(np.float64))
    squares = problem.total(np.where(inlier, residual_px**2, 0.0))
    finite = np.isfinite(moment).all(axis=-1) & np.isfinite(information).all(axis=(-2, -1))
    kept = tracks.observation[inlier]
    return Refined(
        lines=InfiniteLines(direction=direction, moment=moment),
        tracks=LineTracks(offsets=np.concatenate([[0], np.cumsum(counts)]), observation=kept),
        rms_px=np.sqrt(squares / np.maximum(counts, 1.0)),
        origin=problem.origin,
        information=information,
        diverged=~finite | (counts < problem.config.min_inlier_count),
    )
