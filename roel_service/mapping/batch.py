"""The published batch: all lines and one free pose a frame at once, the first pose held.

Held too are frames that see too few lines for a pose.

Paper: "Multi-view Line Optimization" with free poses, and "Pose Refinement". The line term is the
plane-to-line residual or, to compare with, LIMAP's reprojection; the event term is the angle
between the events' rays and the plane that the frame's camera spans with the line. Of a world that
grows with its path no observation says anything: the scale is held at that of the given path, its
root mean square distance from the first pose. Damped Gauss-Newton over all unknowns together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg, sparse

from roel_service.arrays import FloatArray, IntArray
from roel_service.config.stages import RefineConfig
from roel_service.errors import LimitError
from roel_service.geometry import grassmann, plucker, reprojection
from roel_service.geometry.se3 import SE3, skew
from roel_service.geometry.vectors import dot, norm
from roel_service.mapping.frames import Frames
from roel_service.mapping.front_end import Detected
from roel_service.mapping.refine import (
    DAMPING_AFTER_FAILURE,
    DAMPING_AFTER_SUCCESS,
    OrthonormalLines,
    Refined,
)
from roel_service.mapping.views import Views, cuts_m, views_of
from roel_service.scene.lines import InfiniteLines

# Line terms that it has.
RESIDUALS = ("grassmann", "reprojection")
# Unknowns that are solved for at once: their normal equations take 512 MiB.
MAX_UNKNOWN_COUNT = 8192
# A frame that sees fewer lines keeps its pose: nothing would hold it.
MIN_ROW_COUNT = 3
# Steps that are tried, each damped more, before the present state counts as the best one.
MAX_TRIAL_COUNT = 8
# A step that lowers the cost by less than this share ends the iteration.
CONVERGED_SHARE = 1e-6
# Damping relative to the diagonal: at first, and at least, which keeps the system regular along what
# nothing tells.
FIRST_DAMPING, LEAST_DAMPING = 1e-3, 1e-9


@dataclass(frozen=True, eq=False, kw_only=True)
class BatchRefined:
    """Lines and poses after the batch.

    Attributes:
        lines: L lines, world.
        T_world_camera: (N) poses of the frames.
        costs: before the first step and after every one.
        converged: the last step changed next to nothing.
        covariance: (N, 6, 6) of the poses, order (r, d), world; zero for those that were held. The
            noise is what the residuals show.
    """

    lines: InfiniteLines
    T_world_camera: SE3
    covariance: FloatArray
    costs: list[float]
    converged: bool


@dataclass(frozen=True, eq=False, kw_only=True)
class _State:
    lines: OrthonormalLines
    poses: SE3


@dataclass(frozen=True, eq=False, kw_only=True)
class _Term:
    """Residuals of S rows, all weighted.

    Attributes:
        residual: (S, k).
        by_line, by_pose: (S, k, 4) and (S, k, 6), the middle of the line being held.
        by_middle: (S, k, 1) by the middle of the line.
        middle: where that is, and how it moves; None where no residual depends on it.
    """

    residual: FloatArray
    by_line: FloatArray
    by_pose: FloatArray
    by_middle: FloatArray
    middle: _Middles | None = None

    def weighted(self, weight: FloatArray) -> _Term:
        """With every row's squares times its (S,) weight."""
        root = np.sqrt(weight)[:, None, None]
        return replace(
            self,
            residual=root[..., 0] * self.residual,
            by_line=root * self.by_line,
            by_pose=root * self.by_pose,
            by_middle=root * self.by_middle,
        )

    def squared(self) -> _Term:
        """One residual a row, the sum of the row's squares."""
        twice = 2.0 * self.residual[:, None, :]
        return replace(
            self,
            residual=dot(self.residual, self.residual)[:, None],
            by_line=twice @ self.by_line,
            by_pose=twice @ self.by_pose,
            by_middle=twice @ self.by_middle,
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class _Middles:
    """Mean arc lengths of the middles of each line's observed intervals.

    Attributes:
        along_m: (S,) that of each row's line.
        by_line, by_pose: (S, 1, 4) and (S, 1, 6) how each row's line and pose move it.
    """

    along_m: FloatArray
    by_line: FloatArray
    by_pose: FloatArray


def refine_batch(refined: Refined, detected: Detected, config: RefineConfig) -> BatchRefined:
    """Refine all lines and the poses of all frames but the first, and those that see hardly any.

    Args:
        refined: L first estimates with their tracks.
        detected: the frames with their first poses, and what was seen.
        config: residual (`grassmann` or `reprojection`), loss, weight of the event term and number
            of steps.

    Raises:
        LimitError: RECORDING_TOO_LONG, more unknowns than `MAX_UNKNOWN_COUNT`.
    """
    unknown_count = 4 * len(refined) + 6 * (len(detected.frames) - 1)
    if unknown_count > MAX_UNKNOWN_COUNT:
        raise LimitError(
            "lines and poses to refine at once",
            f"at most {MAX_UNKNOWN_COUNT} unknowns",
            f"{unknown_count}",
            reason="RECORDING_TOO_LONG",
        )
    problem = _Problem(refined, detected, config)
    state = problem.first_state(refined.lines, detected.frames.T_world_camera)
    damping = FIRST_DAMPING
    costs = [problem.cost(state)]
    converged = False
    for _ in range(config.pose_iteration_count):
        terms = problem.terms(state)
        weighted_cost = _cost(terms)
        gradient, hessian = problem.normal_equations(terms)
        for _ in range(MAX_TRIAL_COUNT):
            trial = problem.step(state, gradient, hessian, damping)
            cost = problem.cost(trial)
            if cost <= costs[-1]:
                break
            damping *= DAMPING_AFTER_FAILURE
        else:
            converged = True
            break
        state = trial
        damping = max(LEAST_DAMPING, damping * DAMPING_AFTER_SUCCESS)
        costs.append(cost)
        if costs[-2] - cost <= CONVERGED_SHARE * max(weighted_cost, cost):
            converged = True
            break
    return BatchRefined(
        lines=problem.world_lines(state),
        T_world_camera=state.poses,
        covariance=problem.covariance(state),
        costs=costs,
        converged=converged,
    )


class _Problem:
    """The observations of all lines in one list, each row with its line and frame."""

    def __init__(self, refined: Refined, detected: Detected, config: RefineConfig) -> None:
        tracks, evidence = refined.tracks, detected.evidence
        self.config = config
        self.frames = detected.frames
        self.observations = detected.observations
        self.observation = tracks.observation
        self.line = tracks.track_of_row
        self.frame = detected.observations.frame[tracks.observation].astype(np.int64)
        self.line_count = len(refined)
        self.is_held = np.bincount(self.frame, minlength=len(self.frames)) < MIN_ROW_COUNT
        self.is_held[0] = True
        self.origin = refined.origin
        self.length_px = evidence.views.length_px[tracks.observation]
        events = np.minimum(evidence.event_counts, config.event_count_per_line or np.inf)
        self.event_weight = config.event_weight * events[tracks.observation]
        self.root_forms = _roots(evidence.event_forms[tracks.observation][:, 3:, 3:])
        self.extent_m2 = _extent_m2(detected.frames.T_world_camera)

    def first_state(self, lines: InfiniteLines, poses: SE3) -> _State:
        moment = plucker.shift_origin(lines.direction, lines.moment, self.origin)
        U, phi = plucker.orthonormal_from_plucker(lines.direction, moment)
        return _State(lines=OrthonormalLines(U=U, phi=phi), poses=poses)

    def world_lines(self, state: _State) -> InfiniteLines:
        direction, moment = state.lines.plucker
        moment = plucker.shift_origin(direction, moment, -self.origin)
        return InfiniteLines(direction=direction, moment=moment)

    def cost(self, state: _State) -> float:
        """Of all rows; of Cauchy's loss, its logarithms."""
        if self.config.loss != "cauchy":
            return _cost(self.terms(state))
        scale = self.config.loss_scale_px
        squares = (norm(self._line_term(state).residual) / scale) ** 2
        cost = float(np.sum(self.length_px * scale**2 * np.log1p(squares)))
        return cost + (_cost([self._event_term(state)]) if self.config.event_weight else 0.0)

    def terms(self, state: _State) -> list[_Term]:
        """Weighted residuals, with the weights of iterated reweighting where the loss has them."""
        line_term = self._line_term(state)
        if self.config.loss == "quartic":
            line_term = line_term.squared()
        weight = self.length_px
        if self.config.loss == "cauchy":
            scale = self.config.loss_scale_px
            weight = weight / (1.0 + (norm(line_term.residual) / scale) ** 2)
        terms = [line_term.weighted(weight)]
        if self.config.event_weight:
            terms.append(self._event_term(state))
        return terms

    def _line_term(self, state: _State) -> _Term:
        """The residuals of the observed segments."""
        U, phi = state.lines.U[self.line], state.lines.phi[self.line]
        cameras = self._cameras(state)
        if self.config.residual == "reprojection":
            segments_px, K = self.observations.segments_px[self.observation], self.frames.K
            by_line, by_pose = reprojection.end_line_jacobians(segments_px, cameras, U, phi, K)
            v, m = plucker.plucker_from_orthonormal(U, phi)
            distances_px = reprojection.end_line_distances_px(segments_px, cameras, v, m, K)
            return _Term(
                residual=distances_px,
                by_line=by_line,
                by_pose=by_pose,
                by_middle=np.zeros((*distances_px.shape, 1)),
            )
        views = self._views(state)
        v, m = plucker.plucker_from_orthonormal(U, phi)
        middle = self._middles(views, U, phi)
        foot = plucker.nearest_to_origin(v, m) + middle.along_m[:, None] * v
        by_line, by_pose = grassmann.plane_line_jacobians(
            views.normal, views.centre, U, phi, middle.along_m
        )
        d = dot(views.normal, foot - views.centre)
        slope = (1.0 + d * d) ** -1.5 * dot(views.normal, v)
        return _Term(
            residual=grassmann.plane_line_residual(views.normal, views.centre, v, foot),
            by_line=by_line,
            by_pose=by_pose,
            by_middle=np.stack([np.zeros_like(slope), slope], axis=-1)[..., None],
            middle=middle,
        )

    def _event_term(self, state: _State) -> _Term:
        """The weighted residuals of the events: a root of their form times m_c/|m_c|."""
        U, phi = state.lines.U[self.line], state.lines.phi[self.line]
        cameras = self._cameras(state)
        direction, moment = plucker.plucker_from_orthonormal(U, phi)
        moment = plucker.shift_origin(direction, moment, cameras.translation)
        seen = np.einsum("sji,sj->si", cameras.rotation, moment)
        size = norm(seen)[:, None]
        unit = seen / size
        turned = (np.eye(3) - unit[:, :, None] * unit[:, None, :]) / size[..., None]
        by_line, by_pose = plucker.camera_moment_jacobians(cameras, U, phi)
        chain = self.root_forms @ turned
        term = _Term(
            residual=(self.root_forms @ unit[..., None])[..., 0],
            by_line=chain @ by_line,
            by_pose=chain @ by_pose,
            by_middle=np.zeros((len(size), 3, 1)),
        )
        if self.config.loss == "quartic":
            term = term.squared()
        return term.weighted(self.event_weight)

    def _cameras(self, state: _State) -> SE3:
        """(S) T_world_camera about the origin of each row's line."""
        poses = state.poses[self.frame]
        return SE3(rotation=poses.rotation, translation=poses.translation - self.origin[self.line])

    def _views(self, state: _State) -> Views:
        """(S) as seen about the origin of each row's line."""
        frames: Frames = replace(self.frames, T_world_camera=state.poses)
        views = views_of(self.observations, frames).take(self.observation)
        return replace(views, centre=views.centre - self.origin[self.line])

    def _middles(self, views: Views, U: FloatArray, phi: FloatArray) -> _Middles:
        """Of lines that are cut by the planes through the ends N.(x - c) = 0, at x = foot + s v."""
        v, m = plucker.plucker_from_orthonormal(U, phi)
        cuts = cuts_m(views, v, m)[0]
        known = np.asarray(np.isfinite(cuts).all(axis=-1))
        cuts = np.where(known[:, None], cuts, 0.0)
        foot = plucker.nearest_to_origin(v, m)
        view = foot[:, None] + cuts[..., None] * v[:, None] - views.centre[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            normal = views.cut_normal / dot(views.cut_normal, v[:, None])[..., None]
        normal = np.where(known[:, None, None], normal, 0.0)
        by_direction, by_moment = plucker.plucker_jacobians(U, phi)
        by_foot = skew(v) @ by_moment - skew(m) @ by_direction
        by_line = -normal @ by_foot - cuts[..., None] * (normal @ by_direction)
        by_pose = np.concatenate([-np.cross(normal, view), normal], axis=-1)
        counts = np.bincount(self.line[known], minlength=self.line_count)
        share = 1.0 / np.maximum(counts, 1)[self.line]
        sums = np.bincount(self.line, cuts.mean(axis=-1), minlength=self.line_count)
        return _Middles(
            along_m=share * sums[self.line],
            by_line=share[:, None, None] * by_line.mean(axis=1, keepdims=True),
            by_pose=share[:, None, None] * by_pose.mean(axis=1, keepdims=True),
        )

    def normal_equations(self, terms: Sequence[_Term]) -> tuple[FloatArray, FloatArray]:
        """(U,) gradient and (U, U) Hessian; unknowns are lines, then all poses but the first."""
        jacobian = sparse.vstack([self._jacobian(term) for term in terms], format="csr")
        residual = np.concatenate([term.residual.ravel() for term in terms])
        return jacobian.T @ residual, (jacobian.T @ jacobian).toarray()

    def _jacobian(self, term: _Term) -> sparse.csr_array:
        row_count, size = term.residual.shape
        rows = np.arange(row_count * size).reshape(row_count, size, 1)
        found = self._scattered(rows, row_count * size, term.by_line, term.by_pose)
        if term.middle is None:
            return found
        # A line's middle moves with all poses that see it.
        line = self.line[:, None, None]
        moves = self._scattered(line, self.line_count, term.middle.by_line, term.middle.by_pose)
        shape = (row_count * size, self.line_count)
        return found + _sparse(rows, line, term.by_middle, shape) @ moves

    def _scattered(
        self, rows: IntArray, count: int, by_line: FloatArray, by_pose: FloatArray
    ) -> sparse.csr_array:
        """(count, U) values by (S, k, 4) lines and (S, k, 6) poses, at (S, k, 1) rows."""
        shape = (count, 4 * self.line_count + 6 * (len(self.frames) - 1))
        line_columns = 4 * self.line[:, None, None] + np.arange(4)
        first_pose = 4 * self.line_count - 6
        pose_columns = first_pose + 6 * self.frame[:, None, None] + np.arange(6)
        by_pose = np.where(self.is_held[self.frame][:, None, None], 0.0, by_pose)
        lines = _sparse(rows, line_columns, by_line, shape)
        return lines + _sparse(rows, np.maximum(pose_columns, 0), by_pose, shape)

    def step(
        self, state: _State, gradient: FloatArray, hessian: FloatArray, damping: float
    ) -> _State:
        """One damped step of everything."""
        damped, size = _damped(hessian, damping)
        grows, left_m2 = self._growth(state)
        sides = np.stack([-gradient, grows], axis=-1) / size[:, None]
        free, held = linalg.solve(damped, sides, assume_a="pos").T / size
        # As far along what holds the path's extent as brings it back to the given one.
        room = float(grows @ held)
        delta = free + (left_m2 - grows @ free) / room * held if room > 0.0 else free
        by_line = delta[: 4 * self.line_count].reshape(-1, 4)
        by_pose = delta[4 * self.line_count :].reshape(-1, 6)
        U, phi = plucker.retract_orthonormal(state.lines.U, state.lines.phi, by_line)
        poses = state.poses.retract(np.concatenate([np.zeros((1, 6)), by_pose]))
        return _State(lines=OrthonormalLines(U=U, phi=phi), poses=poses)

    def covariance(self, state: _State) -> FloatArray:
        """(N, 6, 6) of the poses, with the scale held."""
        terms = self.terms(state)
        _, hessian = self.normal_equations(terms)
        damped, size = _damped(hessian, LEAST_DAMPING)
        inverse = linalg.inv(damped) / np.outer(size, size)
        grows, _ = self._growth(state)
        along = inverse @ grows
        room = float(grows @ along)
        if room > 0.0:
            inverse -= np.outer(along, along) / room
        row_count = sum(term.residual.size for term in terms)
        variance = _cost(terms) / max(1, row_count - len(hessian))
        covariance = np.zeros((len(self.frames), 6, 6))
        for pose in np.flatnonzero(~self.is_held):
            first = 4 * self.line_count + 6 * (pose - 1)
            covariance[pose] = variance * inverse[first : first + 6, first : first + 6]
        return covariance

    def _growth(self, state: _State) -> tuple[FloatArray, float]:
        """(U,) how the path's extent grows with the unknowns, and what it lacks of the given one."""
        grows = np.zeros(4 * self.line_count + 6 * (len(self.frames) - 1))
        position = state.poses.translation
        by_pose = grows[4 * self.line_count :].reshape(-1, 6)
        by_pose[:, 3:] = 2.0 * (position[1:] - position[0]) / len(position)
        by_pose[self.is_held[1:]] = 0.0
        return grows, self.extent_m2 - _extent_m2(state.poses)


def _damped(hessian: FloatArray, damping: float) -> tuple[FloatArray, FloatArray]:
    """A damped Hessian in units in which its diagonal is one, and the (U,) units.

    Radians and metres do not compare.
    """
    size = np.sqrt(np.diagonal(hessian))
    size[size == 0.0] = 1.0
    damped = hessian / np.outer(size, size)
    damped[np.diag_indices_from(damped)] += damping
    return damped, size


def _extent_m2(poses: SE3) -> float:
    """Mean square distance of the positions from the first one."""
    return float(np.mean(np.sum((poses.translation - poses.translation[0]) ** 2, axis=-1)))


def _cost(terms: Sequence[_Term]) -> float:
    return float(sum(np.sum(term.residual**2) for term in terms))


def _roots(forms: FloatArray) -> FloatArray:
    """(S, 3, 3) matrices F with F^T F the given (S, 3, 3) forms."""
    values, vectors = np.linalg.eigh(forms)
    return np.asarray(np.sqrt(np.maximum(values, 0.0))[:, :, None] * np.swapaxes(vectors, -1, -2))


def _sparse(
    rows: IntArray, columns: IntArray, values: FloatArray, shape: tuple[int, int]
) -> sparse.csr_array:
    """Values (S, k, D) at rows (S, k, 1) and columns (S, 1, D)."""
    row, column = np.broadcast_arrays(rows, columns)
    found = sparse.coo_array((values.ravel(), (row.ravel(), column.ravel())), shape)
    return found.tocsr()
