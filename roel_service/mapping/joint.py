"""Lines and poses refined together.

Paper: "Multi-view Line Optimization" with free poses; the cost is the quadratic form of `refine`,
`residual = "pixel"`. The poses follow a smooth correction of the given trajectory
(`pose_correction`) in place of one free pose a frame: what moves faster than its control points is
taken for noise of the observations. Damped Gauss-Newton; the lines, which share no observation, are
eliminated first (Schur complement), and what is left is a dense system of the control points.
How far the given poses may be off is learned on the way (`Drift.estimated`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg, sparse

from roel_service.arrays import FloatArray
from roel_service.config.stages import RefineConfig
from roel_service.geometry import plucker, projection
from roel_service.geometry.se3 import SE3, rotation_vector_jacobian
from roel_service.geometry.vectors import norm
from roel_service.mapping import joint_kernels
from roel_service.mapping.front_end import Detected
from roel_service.mapping.pose_correction import Drift, PoseCorrection
from roel_service.mapping.refine import (
    DAMPING_AFTER_FAILURE,
    DAMPING_AFTER_SUCCESS,
    FIRST_DAMPING,
    FIRST_GATE,
    LOOSE_ITERATION_COUNT,
    MAX_TURN_RAD,
    RIDGE,
    DirectionPrior,
    OrthonormalLines,
    Refined,
    direction_system,
)
from roel_service.scene.lines import InfiniteLines

# Steps that are tried, each damped more, before the present state counts as the best one.
MAX_TRIAL_COUNT = 6
# An estimated drift is at least this share of the configured one.
LEAST_DRIFT_SHARE = 0.01
# A step that lowers the cost by less than this share ends the iteration.
CONVERGED_SHARE = 1e-4
# Doubles of the blocks that are in memory at a time while lines are eliminated: 64 MiB.
BLOCK_SIZE = 2**23


@dataclass(frozen=True, eq=False, kw_only=True)
class JointlyRefined:
    """Lines and the correction of the poses that they were refined with.

    Attributes:
        lines: L lines, world.
        correction: of the trajectory that the frames' poses came from.
        drift: of that trajectory, as the correction tells it, in position no larger than expected.
        drift_told: the same, however large.
        information: (6 K, 6 K) of the control points, the lines being free; 1/(rad, m)^2.
        costs: of the observations after each step, the first one before any; in units of their
            noise.
        converged: the last step changed next to nothing.
    """

    lines: InfiniteLines
    correction: PoseCorrection
    drift: Drift
    drift_told: Drift
    information: FloatArray
    costs: list[float]
    converged: bool


@dataclass(frozen=True, eq=False, kw_only=True)
class _State:
    lines: OrthonormalLines
    correction: PoseCorrection
    drift: Drift
    drift_told: Drift


@dataclass(frozen=True, eq=False, kw_only=True)
class _System:
    """Normal equations of lines, control points, and of each row between them.

    Attributes:
        cost: of everything.
        observation_cost: of the observations alone.
        line_gradient, line_hessian: (L, 4) and (L, 4, 4).
        control_gradient, control_hessian: (6 K,) and (6 K, 6 K).
        rows: (S, 4, 6) by line and pose.
    """

    cost: float
    observation_cost: float
    line_gradient: FloatArray
    line_hessian: FloatArray
    control_gradient: FloatArray
    control_hessian: FloatArray
    rows: FloatArray


@dataclass(frozen=True, eq=False, kw_only=True)
class _Reduced:
    """The normal equations of the control points, the lines being eliminated.

    Attributes:
        hessian, gradient: (6 K, 6 K) and (6 K,), damped.
        line_inverse: (L, 4, 4) what then solves for the lines.
    """

    hessian: FloatArray
    gradient: FloatArray
    line_inverse: FloatArray


def refine_jointly(
    refined: Refined,
    correction: PoseCorrection,
    drift: Drift,
    detected: Detected,
    config: RefineConfig,
    directions: DirectionPrior | None,
    *,
    free_lines: bool = True,
) -> JointlyRefined:
    """Refine lines and the correction of the poses over the lines' observations.

    Args:
        refined: L first estimates with their tracks.
        correction: the first estimate, of what the poses of the frames lack.
        drift: the first estimate of how large that is.
        detected: the frames with the poses that the correction applies to, and what was seen.
        config: loss, gates, noise of an observation, drift of the poses and number of steps.
        directions: that lines are held to.
        free_lines: whether the lines move too.
    """
    problem = _Problem(refined, correction, detected, config, directions, free_lines=free_lines)
    state = problem.first_state(refined.lines, correction, drift)
    damping = FIRST_DAMPING
    costs: list[float] = []
    converged = False
    for iteration in range(config.pose_iteration_count):
        weight = problem.weight(state, loose=iteration < LOOSE_ITERATION_COUNT)
        system = problem.system(state, weight)
        costs.append(system.observation_cost)
        for _ in range(MAX_TRIAL_COUNT):
            reduced = problem.reduced(system, damping)
            trial, cost = problem.step(state, system, reduced, weight)
            if cost <= system.cost:
                break
            damping *= DAMPING_AFTER_FAILURE
        else:
            converged = True
            break
        state = problem.with_drift(trial, reduced)
        damping *= DAMPING_AFTER_SUCCESS
        converged = system.cost - cost <= CONVERGED_SHARE * system.cost
        if converged and iteration >= LOOSE_ITERATION_COUNT:
            break
    system = problem.system(state, problem.weight(state, loose=False))
    return JointlyRefined(
        lines=problem.world_lines(state),
        correction=state.correction,
        drift=state.drift,
        drift_told=state.drift_told,
        information=problem.reduced(system, 0.0).hessian,
        costs=[*costs, system.observation_cost],
        converged=converged,
    )


def _believed(prior: DirectionPrior, lines: InfiniteLines, config: RefineConfig) -> DirectionPrior:
    """The directions of lines, the less held to the farther the lines are from them.

    A line that fits a direction only as it hardly knows its own would move poses to turn.
    """
    sine = norm(np.cross(lines.direction, prior.direction))
    scale = config.max_direction_distance * np.deg2rad(config.direction_sigma_deg)
    return replace(prior, weight=prior.weight / (1.0 + (sine / scale) ** 2) ** 2)


class _Problem:
    """The observations of all lines in one list, each row with its line and frame."""

    def __init__(
        self,
        refined: Refined,
        correction: PoseCorrection,
        detected: Detected,
        config: RefineConfig,
        directions: DirectionPrior | None,
        *,
        free_lines: bool,
    ) -> None:
        frames, evidence = detected.frames, detected.evidence
        self.config = config
        self.free_lines = free_lines
        self.frames = frames
        self.end_rays = projection.ray_from_pixel(detected.observations.segments_px, frames.K)
        self.frame_of = evidence.views.frame
        self.offsets = refined.tracks.offsets
        self.observation = refined.tracks.observation
        self.line = refined.tracks.track_of_row
        self.origin = refined.origin
        self.directions = directions and _believed(directions, refined.lines, config)
        self.precision = config.pose_noise_px**-2
        self.forms = frames.focal_px**2 * (
            evidence.segment_forms + config.event_weight * evidence.event_forms
        )
        length_px = evidence.views.length_px[self.observation]
        most_px = config.max_length_weight_px
        self.length_weight = np.minimum(length_px, most_px) / most_px
        self.first_control, self.basis = correction.basis(frames.t_us)
        self.shares = correction.shares(frames.t_us)

    def first_state(self, lines: InfiniteLines, correction: PoseCorrection, drift: Drift) -> _State:
        moment = plucker.shift_origin(lines.direction, lines.moment, self.origin)
        U, phi = plucker.orthonormal_from_plucker(lines.direction, moment)
        return _State(
            lines=OrthonormalLines(U=U, phi=phi),
            correction=correction,
            drift=drift,
            drift_told=drift,
        )

    def world_lines(self, state: _State) -> InfiniteLines:
        direction, moment = state.lines.plucker
        moment = plucker.shift_origin(direction, moment, -self.origin)
        return InfiniteLines(direction=direction, moment=moment)

    def moved_poses(self, state: _State) -> SE3:
        """(N) corrected poses of the frames."""
        return state.correction.applied(self.frames.t_us, self.frames.T_world_camera)

    def weight(self, state: _State, *, loose: bool) -> FloatArray:
        """(S,) weights of iterated reweighting, 0 for outliers."""
        v, m = state.lines.plucker
        poses = self.moved_poses(state)
        residual_px = joint_kernels.end_residuals(
            self.offsets,
            self.origin,
            v,
            m,
            poses.rotation,
            poses.translation,
            self.frame_of,
            self.observation,
            self.end_rays,
            self.frames.focal_px,
        )
        gate_px = self.config.max_residual_px * (FIRST_GATE if loose else 1.0)
        robust = 1.0 / (1.0 + (residual_px / self.config.loss_scale_px) ** 2)
        return np.asarray(
            np.where(residual_px < gate_px, robust, 0.0) * self.length_weight * self.precision
        )

    def line_costs(self, lines: OrthonormalLines, poses: SE3, weight: FloatArray) -> FloatArray:
        """(L,) of observations and directions, with fixed (S,) weights."""
        v, m = lines.plucker
        cost = joint_kernels.joint_cost(
            self.offsets,
            self.origin,
            v,
            m,
            poses.rotation,
            poses.translation,
            self.frame_of,
            self.observation,
            self.forms,
            weight,
        )
        if self.directions is not None:
            cost = cost + self.precision * direction_system(lines, self.directions).cost
        return np.asarray(cost)

    def drift_cost(self, state: _State) -> float:
        """Of the correction itself."""
        return float(np.sum(state.correction.control * state.drift.pull(state.correction)))

    def system(self, state: _State, weight: FloatArray) -> _System:
        """Normal equations with fixed (S,) weights."""
        v, m = state.lines.plucker
        dv, dm = plucker.plucker_jacobians(state.lines.U, state.lines.phi)
        poses = self.moved_poses(state)
        cost, by_line, by_lines, by_pose, by_poses, rows = joint_kernels.joint_system(
            self.offsets,
            self.origin,
            v,
            m,
            np.concatenate([dv, dm], axis=-2),
            poses.rotation,
            poses.translation,
            self.frame_of,
            self.observation,
            self.forms,
            weight,
        )
        observation_cost = float(cost.sum())
        if self.directions is not None:
            held = direction_system(state.lines, self.directions)
            cost = cost + self.precision * held.cost
            by_line = by_line + self.precision * held.gradient
            by_lines = by_lines + self.precision * held.hessian
        by_tangent = self._pose_by_tangent(state)
        by_pose = np.einsum("nij,ni->nj", by_tangent, by_pose)
        by_poses = np.swapaxes(by_tangent, -1, -2) @ by_poses @ by_tangent
        rows = rows @ by_tangent[self.frame_of[self.observation]]
        # Of the control points; a frame depends on four of them, so nothing large is dense.
        control_by_frame = sparse.kron(self.shares, np.eye(6), format="csr")
        frame_count = len(by_poses)
        blocks = sparse.bsr_array((by_poses, np.arange(frame_count), np.arange(frame_count + 1)))
        hessian = (control_by_frame.T @ blocks @ control_by_frame).toarray()
        return _System(
            cost=float(cost.sum()) + self.drift_cost(state),
            observation_cost=observation_cost,
            line_gradient=by_line,
            line_hessian=by_lines,
            control_gradient=control_by_frame.T @ by_pose.ravel()
            + state.drift.pull(state.correction).ravel(),
            control_hessian=hessian + state.drift.information(state.correction),
            rows=rows,
        )

    def _pose_by_tangent(self, state: _State) -> FloatArray:
        """(N, 6, 6) how a pose steps (r, d) when its correction's tangent changes."""
        tangent = self.shares @ state.correction.control
        derivative = np.tile(np.eye(6), (len(tangent), 1, 1))
        derivative[:, :3, :3] = rotation_vector_jacobian(tangent[:, :3])
        return derivative

    def reduced(self, system: _System, damping: float) -> _Reduced:
        """The system of the control points alone."""
        diagonal = np.einsum("lii->li", system.line_hessian)
        damped = system.line_hessian + np.einsum(
            "li,ij->lij", damping * diagonal + RIDGE, np.eye(4)
        )
        inverse = np.linalg.inv(damped)
        # (L, 4, 4) with factor^T factor = inverse: the product below stays symmetric.
        factor = np.swapaxes(np.linalg.cholesky(inverse), -1, -2)
        hessian, gradient = system.control_hessian.copy(), system.control_gradient.copy()
        for lines, blocks in self._blocks(system) if self.free_lines else ():
            solved = (factor[lines] @ blocks).reshape(-1, hessian.shape[0])
            hessian -= solved.T @ solved
            weighted = np.einsum("lij,lj->li", inverse[lines], system.line_gradient[lines])
            gradient -= np.einsum("lik,li->k", blocks, weighted)
        hessian[np.diag_indices_from(hessian)] *= 1.0 + damping
        return _Reduced(hessian=hessian, gradient=gradient, line_inverse=inverse)

    def _blocks(self, system: _System) -> Iterator[tuple[slice, FloatArray]]:
        """Lines in turn with their (l, 4, 6 K) blocks by the control points."""
        control_count = self.shares.shape[1]
        step = max(1, BLOCK_SIZE // (4 * 6 * control_count))
        line_count = len(self.offsets) - 1
        for first in range(0, line_count, step):
            last = min(first + step, line_count)
            yield (
                slice(first, last),
                joint_kernels.by_control(
                    self.offsets,
                    self.frame_of,
                    self.observation,
                    system.rows,
                    self.first_control,
                    self.basis,
                    control_count,
                    first,
                    last,
                ),
            )

    def step(
        self, state: _State, system: _System, reduced: _Reduced, weight: FloatArray
    ) -> tuple[_State, float]:
        """One step of everything, and what it then costs with fixed (S,) weights.

        Lines that are better off where they are stay: a line that hardly anything holds would
        else stop all others.
        """
        solved = linalg.solve(reduced.hessian, reduced.gradient, assume_a="pos")
        control = -solved.reshape(-1, 6)
        moved = replace(state, correction=state.correction.stepped(control))
        poses = self.moved_poses(moved)
        costs = self.line_costs(state.lines, poses, weight)
        if self.free_lines:
            stepped = self._stepped_lines(state, system, reduced, control)
            stepped_costs = self.line_costs(stepped, poses, weight)
            better = stepped_costs < costs
            lines = OrthonormalLines(
                U=np.where(better[:, None, None], stepped.U, state.lines.U),
                phi=np.where(better, stepped.phi, state.lines.phi),
            )
            moved = replace(moved, lines=lines)
            costs = np.where(better, stepped_costs, costs)
        return moved, float(costs.sum()) + self.drift_cost(moved)

    def _stepped_lines(
        self, state: _State, system: _System, reduced: _Reduced, control: FloatArray
    ) -> OrthonormalLines:
        """The lines that follow a (K, 6) step of the control points."""
        by_pose = (self.shares @ control)[self.frame_of[self.observation]]
        pulls = np.einsum("sij,sj->si", system.rows, by_pose)
        pull = np.stack([self._total(column) for column in pulls.T], axis=1)
        delta = -np.einsum("lij,lj->li", reduced.line_inverse, system.line_gradient + pull)
        turn = np.linalg.norm(delta[:, :3], axis=1)
        delta *= np.minimum(1.0, MAX_TURN_RAD / np.maximum(turn, MAX_TURN_RAD))[:, None]
        U, phi = plucker.retract_orthonormal(state.lines.U, state.lines.phi, delta)
        return OrthonormalLines(U=U, phi=phi)

    def with_drift(self, state: _State, reduced: _Reduced) -> _State:
        """With the drift that the correction tells of, as well as the last step's system knows."""
        covariance = np.asarray(np.linalg.inv(reduced.hessian), dtype=np.float64)
        told = state.drift.estimated(state.correction, covariance)
        configured = Drift.configured(self.config)
        drift = told.at_least(LEAST_DRIFT_SHARE, configured)
        # The path's size and shape are what lines hold least: its drift would feed on itself.
        drift = replace(drift, sigma_m=min(drift.sigma_m, configured.sigma_m))
        return replace(state, drift=drift, drift_told=told)

    def _total(self, rows: FloatArray) -> FloatArray:
        """(L,) sums of (S,) rows over each line."""
        sums = np.bincount(self.line, rows, minlength=len(self.offsets) - 1)
        return np.asarray(sums, dtype=np.float64)
