"""Lines and poses refined together.

Paper: "Multi-view Line Optimization" with free poses; the cost is the quadratic form of `refine`,
`residual = "pixel"`. The poses follow a smooth correction of the given trajectory
(`pose_correction`) in place of one free pose a frame: what moves faster than its control points is
taken for noise of the observations. Damped Gauss-Newton; the lines, which share no observation, are
eliminated first (Schur complement), and what is left is a dense system of the control points.
How far the given poses may be off is learned on the way (`Drift.estimated`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from scipy import linalg, sparse

from roel_service.arrays import Array, FloatArray
from roel_service.config.stages import RefineConfig
from roel_service.geometry import plucker, projection
from roel_service.geometry.se3 import SE3, rotation_vector_jacobian
from roel_service.geometry.vectors import norm
from roel_service.in_order import in_order
from roel_service.mapping import joint_kernels
from roel_service.mapping.front_end import Detected
from roel_service.mapping.line_parts import PART_COUNT, LinePart, line_parts
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
    direction_cost,
    direction_system,
)
from roel_service.scene.lines import InfiniteLines

Result = TypeVar("Result")
# What `joint_kernels.end_residuals` and `joint_cost` share.
SeenArguments = tuple[Array, Array, Array, Array, Array, Array, Array, Array]
# Those of `joint_kernels.joint_system`, but for the weights.
SystemArguments = tuple[Array, Array, Array, Array, Array, Array, Array, Array, Array, Array, Array]

# Steps that are tried, each damped more, before the present state counts as the best one.
MAX_TRIAL_COUNT = 6
# Errors that all observations of a line have in common feign a drift of so much in exact poses.
FEIGNED_DRIFT = Drift(sigma_rad=float(np.deg2rad(0.03)), sigma_m=1e-3, forgets_s=1.0)
# An estimated drift is at least this share of the configured one.
LEAST_DRIFT_SHARE = 0.01
# A step that lowers the cost by less than this share ends the iteration.
CONVERGED_SHARE = 1e-4
# What the parts of the lines take from the control points' equations has at most so many elements in
# all: 64 MiB. There are fewer parts else.
MAX_ELEMENT_COUNT = 2**23


@dataclass(frozen=True, kw_only=True)
class FocalError:
    """By how much the true focal length is larger than the given one, as a share of it.

    Attributes:
        share: the estimate, linearised.
        sigma: its standard deviation; infinite where nothing tells.
    """

    share: float
    sigma: float

    def exceeds(self, least: float, sigma_count: float) -> bool:
        """Whether it is large, and surely so."""
        return abs(self.share) > max(least, sigma_count * self.sigma)


@dataclass(frozen=True, eq=False, kw_only=True)
class JointlyRefined:
    """Lines and the correction of the poses that they were refined with.

    What is known of them is worked out when it is asked for: of many rounds, only the last one is.

    Attributes:
        lines: L lines, world.
        correction: of the trajectory that the frames' poses came from.
        drift: of that trajectory, as the correction tells it, in position no larger than expected.
        drift_told: the same, however large.
        costs: of the observations before each step; in units of their noise.
        converged: the last step changed next to nothing.
        moved_px: root mean square of what the observations' distances from their lines have changed
            by, none by more than the gate.
        problem, end: what was solved, and its solution.
    """

    lines: InfiniteLines
    correction: PoseCorrection
    drift: Drift
    drift_told: Drift
    costs: list[float]
    converged: bool
    moved_px: float
    problem: _Problem
    end: _State

    @cached_property
    def _weight(self) -> FloatArray:
        return self.problem.weight(self.end, loose=False)

    @cached_property
    def _system(self) -> _System:
        return self.problem.system(self.end, self._weight)

    @property
    def cost(self) -> float:
        """Of the observations at the end, in units of their noise."""
        return self._system.observation_cost

    @property
    def robust_cost(self) -> float:
        """Of the observations by their loss and of the correction by the drift, at the end.

        It can be compared between runs.
        """
        return self.problem.robust_cost(self.end)

    @cached_property
    def information(self) -> FloatArray:
        """(6 K, 6 K) of the control points, the lines being free; 1/(rad, m)^2."""
        return self.problem.reduced(self._system, 0.0).hessian

    @property
    def focal_error(self) -> FocalError:
        """What poses, lines and observations say of the calibration."""
        return self.problem.focal_error(self.end, self._system, self._weight)


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
        rows: (S, 4, 6) by the line and the tangent of the pose.
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
    worker_count: int = 1,
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
        worker_count: threads.
    """
    problem = _Problem(
        refined,
        correction,
        detected,
        config,
        directions,
        free_lines=free_lines,
        worker_count=worker_count,
    )
    first = state = problem.first_state(refined.lines, correction, drift)
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
    return JointlyRefined(
        lines=problem.world_lines(state),
        correction=state.correction,
        drift=state.drift,
        drift_told=state.drift_told,
        costs=costs,
        converged=converged,
        moved_px=problem.moved_px(first, state),
        problem=problem,
        end=state,
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
        worker_count: int = 1,
    ) -> None:
        frames, evidence = detected.frames, detected.evidence
        self.config = config
        self.free_lines = free_lines
        self.worker_count = worker_count
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
        most = MAX_ELEMENT_COUNT // (6 * len(correction)) ** 2
        self.parts = line_parts(self.offsets, max(1, min(PART_COUNT, most)))

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
        residual_px = self.residuals_px(state)
        gate_px = self.config.max_residual_px * (FIRST_GATE if loose else 1.0)
        robust = 1.0 / (1.0 + (residual_px / self.config.loss_scale_px) ** 2)
        return np.asarray(
            np.where(residual_px < gate_px, robust, 0.0) * self.length_weight * self.precision
        )

    def robust_cost(self, state: _State) -> float:
        """Of the observations by the loss that `weight` is of, none more than at the gate; and drift."""
        config = self.config
        residual_px = np.minimum(self.residuals_px(state), config.max_residual_px)
        loss_px2 = config.loss_scale_px**2 * np.log1p((residual_px / config.loss_scale_px) ** 2)
        return float(self.precision * self.length_weight @ loss_px2) + self.drift_cost(state)

    def residuals_px(self, state: _State) -> FloatArray:
        """(S,) distances of the observations' ends from their lines."""
        seen = self._seen(state.lines, self.moved_poses(state))

        def residuals_of(part: LinePart) -> FloatArray:
            return joint_kernels.end_residuals(*seen(part), self.end_rays, self.frames.focal_px)

        return np.concatenate(self._of_parts(residuals_of))

    def moved_px(self, first: _State, last: _State) -> float:
        """Root mean square of what residuals differ by, none by more than the gate."""
        change_px = np.abs(self.residuals_px(last) - self.residuals_px(first))
        capped_px = np.minimum(change_px, self.config.max_residual_px)
        return float(np.sqrt(np.mean(capped_px**2)))

    def line_costs(self, lines: OrthonormalLines, poses: SE3, weight: FloatArray) -> FloatArray:
        """(L,) of observations and directions, with fixed (S,) weights."""
        seen = self._seen(lines, poses)

        def costs_of(part: LinePart) -> FloatArray:
            return joint_kernels.joint_cost(*seen(part), self.forms, weight[part.rows])

        cost = np.concatenate(self._of_parts(costs_of))
        if self.directions is not None:
            cost = cost + self.precision * direction_cost(lines, self.directions)
        return np.asarray(cost)

    def _seen(self, lines: OrthonormalLines, poses: SE3) -> Callable[[LinePart], SeenArguments]:
        """Lines and the frames that see them, for a part of the lines."""
        v, m = lines.plucker

        def arguments(part: LinePart) -> SeenArguments:
            return (
                part.offsets,
                self.origin[part.lines],
                v[part.lines],
                m[part.lines],
                poses.rotation,
                poses.translation,
                self.frame_of,
                self.observation[part.rows],
            )

        return arguments

    def drift_cost(self, state: _State) -> float:
        """Of the correction itself."""
        return float(np.sum(state.correction.control * state.drift.pull(state.correction)))

    def system(self, state: _State, weight: FloatArray) -> _System:
        """Normal equations with fixed (S,) weights."""
        cost, by_line, by_lines, by_pose, by_poses, rows = self._by_tangents(state, weight)
        observation_cost = float(cost.sum())
        if self.directions is not None:
            held = direction_system(state.lines, self.directions)
            cost = cost + self.precision * held.cost
            by_line = by_line + self.precision * held.gradient
            by_lines = by_lines + self.precision * held.hessian
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

    def _by_tangents(self, state: _State, weight: FloatArray) -> tuple[FloatArray, ...]:
        """What `joint_system` finds, by the tangents of the poses."""
        seen = self._linearised(state)

        def system_of(part: LinePart) -> tuple[FloatArray, ...]:
            return joint_kernels.joint_system(*seen(part), weight[part.rows])

        cost, by_line, by_lines, by_pose, by_poses, rows = zip(
            *self._of_parts(system_of), strict=True
        )
        return (
            np.concatenate(cost),
            np.concatenate(by_line),
            np.concatenate(by_lines),
            np.sum(by_pose, axis=0),
            np.sum(by_poses, axis=0),
            np.concatenate(rows),
        )

    def _linearised(self, state: _State) -> Callable[[LinePart], SystemArguments]:
        """The arguments of `joint_system` for a part of the lines, but for the weights."""
        v, m = state.lines.plucker
        jacobian = np.concatenate(
            plucker.plucker_jacobians(state.lines.U, state.lines.phi), axis=-2
        )
        poses = self.moved_poses(state)
        tangent = self.shares @ state.correction.control
        by_tangent = rotation_vector_jacobian(tangent[:, :3])

        def arguments(part: LinePart) -> SystemArguments:
            return (
                part.offsets,
                self.origin[part.lines],
                v[part.lines],
                m[part.lines],
                jacobian[part.lines],
                poses.rotation,
                poses.translation,
                by_tangent,
                self.frame_of,
                self.observation[part.rows],
                self.forms,
            )

        return arguments

    def reduced(self, system: _System, damping: float) -> _Reduced:
        """The system of the control points alone."""
        diagonal = np.einsum("lii->li", system.line_hessian)
        damped = system.line_hessian + np.einsum(
            "li,ij->lij", damping * diagonal + RIDGE, np.eye(4)
        )
        inverse = np.linalg.inv(damped)
        hessian, gradient = system.control_hessian.copy(), system.control_gradient.copy()
        if self.free_lines:
            taken, pull = self._taken_by_lines(system, inverse)
            hessian -= taken
            gradient -= pull
        hessian[np.diag_indices_from(hessian)] *= 1.0 + damping
        return _Reduced(hessian=hessian, gradient=gradient, line_inverse=inverse)

    def _taken_by_lines(
        self, system: _System, inverse: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """(6 K, 6 K) and (6 K,) what eliminating the lines takes from the control points' equations.

        Args:
            inverse: (L, 4, 4) of the lines' damped Hessians.
        """
        # (L, 4, 4) with factor^T factor = inverse: the product stays symmetric.
        factor = np.ascontiguousarray(np.swapaxes(np.linalg.cholesky(inverse), -1, -2))
        frame = self.frame_of[self.observation]

        def taken_by(part: LinePart) -> tuple[FloatArray, FloatArray]:
            return joint_kernels.eliminated(
                part.offsets,
                system.rows[part.rows],
                factor[part.lines],
                system.line_gradient[part.lines],
                self.first_control[frame[part.rows]],
                self.basis[frame[part.rows]],
                self.shares.shape[1],
            )

        taken, pull = (sum(of_parts) for of_parts in zip(*self._of_parts(taken_by), strict=True))
        return np.asarray(np.triu(taken) + np.triu(taken, 1).T), np.asarray(pull)

    def focal_error(self, state: _State, system: _System, weight: FloatArray) -> FocalError:
        """One step of the focal length together with everything else, and how sure it is.

        Args:
            system: normal equations of this state, with these (S,) weights.
        """
        gradient, hessian, by_line, by_pose = joint_kernels.focal_system(
            *self._linearised(state)(line_parts(self.offsets, 1)[0]), weight
        )
        by_control = (self.shares.T @ by_pose).ravel()
        reduced = self.reduced(system, 0.0)
        if self.free_lines:
            solved = np.einsum("lij,lj->li", reduced.line_inverse, by_line)
            gradient -= float(np.sum(solved * system.line_gradient))
            hessian -= float(np.sum(solved * by_line))
            crossed = replace(system, line_gradient=by_line)
            by_control = by_control - self._taken_by_lines(crossed, reduced.line_inverse)[1]
        held = linalg.solve(reduced.hessian, by_control, assume_a="pos")
        information = hessian - float(held @ by_control)
        if information <= 0.0:
            return FocalError(share=0.0, sigma=float("inf"))
        share = -(gradient - float(held @ reduced.gradient)) / information
        return FocalError(share=share, sigma=information**-0.5)

    def _of_parts(self, function: Callable[[LinePart], Result]) -> list[Result]:
        """What a function makes of each part of the lines; in threads, always the same parts."""
        return list(in_order(function, self.parts, self.worker_count))

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
        drift = told.beyond(FEIGNED_DRIFT).at_least(LEAST_DRIFT_SHARE, configured)
        # The path's size and shape are what lines hold least: its drift would feed on itself.
        drift = replace(drift, sigma_m=min(drift.sigma_m, configured.sigma_m))
        return replace(state, drift=drift, drift_told=told)

    def _total(self, rows: FloatArray) -> FloatArray:
        """(L,) sums of (S,) rows over each line."""
        sums = np.bincount(self.line, rows, minlength=len(self.offsets) - 1)
        return np.asarray(sums, dtype=np.float64)
