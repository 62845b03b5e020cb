"""A coarse pose made finer: translation by intersections, then rotation by the lines they are of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roel_service.arrays import FloatArray, IntArray
from roel_service.geometry.se3 import SE3, rotation_angle
from roel_service.geometry.vectors import dot, norm
from roel_service.pano_loc.fgpl import distance_kernels
from roel_service.pano_loc.fgpl.intersections import Intersections

ITERATION_COUNT = 100
STEP = 0.1
PATIENCE, DECAY = 5, 0.9
# Of Adam.
BETAS, EPSILON = (0.9, 0.999), 1e-8
# An improvement is at least this share.
PLATEAU_SHARE = 1e-4
# Intersections match at this chord on the unit sphere if they are of the same pair, or of any.
MAX_CHORD, MAX_CHORD_ANY_PAIR = 0.5, 0.1
# Pairs of an arc and a line count below this cost.
MAX_ROTATION_COST = 0.2
# Poses that moved farther were led astray.
MAX_SHIFT_M, MAX_TURN_RAD = 1.0, np.deg2rad(60.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class Refined:
    """A pose after refinement.

    Attributes:
        pose: T_world_picture.
        loss: mean distance of the matches; infinite without any.
        is_refined: whether it is more than the coarse pose.
    """

    pose: SE3
    loss: float
    is_refined: bool


@dataclass(kw_only=True)
class _Adam:
    """Adam, whose step shrinks when the loss stays where it is."""

    mean: FloatArray
    square: FloatArray
    count: int = 0
    step: float = STEP
    best: float = np.inf
    bad_count: int = 0

    def change(self, gradient: FloatArray, loss: float) -> FloatArray:
        """What to subtract; the step shrinks for the next time."""
        self.count += 1
        self.mean = BETAS[0] * self.mean + (1 - BETAS[0]) * gradient
        self.square = BETAS[1] * self.square + (1 - BETAS[1]) * gradient**2
        mean = self.mean / (1 - BETAS[0] ** self.count)
        square = self.square / (1 - BETAS[1] ** self.count)
        change = self.step * mean / (np.sqrt(square) + EPSILON)
        if loss < self.best * (1 - PLATEAU_SHARE):
            self.best, self.bad_count = loss, 0
        else:
            self.bad_count += 1
        if self.bad_count > PATIENCE:
            self.step, self.bad_count = DECAY * self.step, 0
        return np.asarray(change)


def refine_pose(
    coarse: SE3,
    seen: Intersections,
    seen_normals: FloatArray,
    known: Intersections,
    known_directions: FloatArray,
    *,
    cost_per_axis: bool,
) -> Refined:
    """The pose with the translation refined first, and the rotation after it.

    Args:
        coarse: T_world_picture.
        seen: the picture's intersections, by pairs of the map's directions.
        seen_normals: (A, 3) of the arcs that they are of.
        known: the map's.
        known_directions: (L, 3) unit, of the lines that they are of.
        cost_per_axis: as in `FgplParameters`.
    """
    place, loss, matches = refine_translation(coarse, seen, known)
    if len(matches) == 0:
        return Refined(pose=coarse, loss=loss, is_refined=False)
    arcs, lines = seen.lines[matches[:, 0]], known.lines[matches[:, 1]]
    rotation = refine_rotation(
        coarse.rotation,
        seen_normals[arcs.T.ravel()],
        known_directions[np.stack([lines.T.ravel(), lines[:, ::-1].T.ravel()], axis=1)],
        cost_per_axis=cost_per_axis,
    )
    moved_far = norm(place - coarse.translation) > MAX_SHIFT_M
    if moved_far or rotation_angle(rotation @ coarse.rotation.T) > MAX_TURN_RAD:
        return Refined(pose=coarse, loss=loss, is_refined=False)
    return Refined(pose=SE3(rotation=rotation, translation=place), loss=loss, is_refined=True)


def refine_translation(
    coarse: SE3, seen: Intersections, known: Intersections
) -> tuple[FloatArray, float, IntArray]:
    """The place, its loss, and the last (M, 2) matches of the same pair; all of the last round."""
    place = coarse.translation
    optimizer = _Adam(mean=np.zeros(3), square=np.zeros(3))
    loss, same = np.inf, np.empty((0, 2), np.int64)
    for _ in range(ITERATION_COUNT):
        offset = (known.points - place) @ coarse.rotation
        distance_m = np.maximum(norm(offset), 1e-9)
        projected = offset / distance_m[:, None]
        same = _matches(seen, projected, known.pair, MAX_CHORD, same_pair=True)
        near = _matches(seen, projected, known.pair, MAX_CHORD_ANY_PAIR, same_pair=False)
        i, j = np.concatenate([same, near]).T
        if len(i) == 0:
            break
        difference = projected[j] - seen.points[i]
        loss = float(np.abs(difference).sum(axis=1).mean())
        # d|p - m|/dt, of p = R'(X - t) / distance.
        sign, p = np.sign(difference), projected[j]
        slope = (sign - dot(sign, p)[:, None] * p) / distance_m[j, None]
        gradient = -(slope @ coarse.rotation.T).mean(axis=0)
        place = place - optimizer.change(gradient, loss)
    return place, loss, same


def _matches(
    seen: Intersections, projected: FloatArray, pair: IntArray, max_chord: float, *, same_pair: bool
) -> IntArray:
    min_cosine = 1.0 - max_chord**2 / 2
    return distance_kernels.mutual_nearest(
        seen.points, seen.pair, projected, pair, min_cosine, same_pair
    )


def refine_rotation(
    rotation: FloatArray, normals: FloatArray, directions: FloatArray, *, cost_per_axis: bool
) -> FloatArray:
    """(3, 3) R_world_picture after steps on yaw, pitch and roll of its inverse.

    Args:
        rotation: (3, 3) R_world_picture.
        normals: (M, 3) of arcs, picture.
        directions: (M, 2, 3) of the two lines that each arc may be, world.
        cost_per_axis: as in `FgplParameters`.
    """
    angles = _angles(rotation.T)
    optimizer = _Adam(mean=np.zeros(3), square=np.zeros(3))
    for _ in range(ITERATION_COUNT):
        R, slopes = _rotation(angles)
        product = (normals @ R)[:, None] * directions
        inner = np.abs(product) if cost_per_axis else product
        cost = np.abs(inner.sum(axis=2))
        which = cost.argmin(axis=1)
        rows = np.arange(len(cost))
        counts = cost[rows, which] < MAX_ROTATION_COST
        if not counts.any():
            break
        rows, which = rows[counts], which[counts]
        d, chosen = directions[rows, which], product[rows, which]
        sign = np.sign(chosen) if cost_per_axis else np.sign(chosen.sum(axis=1, keepdims=True))
        gradient = np.array([dot(sign * (normals[rows] @ slope), d).mean() for slope in slopes])
        angles = angles - optimizer.change(gradient, float(cost[rows, which].mean()))
    return np.asarray(_rotation(angles)[0].T)


def _angles(R: FloatArray) -> FloatArray:
    """(3,) yaw, pitch and roll with R = Rz(yaw) Ry(pitch) Rx(roll)."""
    return np.array(
        [
            np.arctan2(R[1, 0], R[0, 0]),
            np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0])),
            np.arctan2(R[2, 1], R[2, 2]),
        ]
    )


def _rotation(angles: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
    """R and its three derivatives by the angles."""
    (Rz, dRz), (Ry, dRy), (Rx, dRx) = (
        _about(axis, angle) for axis, angle in zip((2, 1, 0), angles, strict=True)
    )
    return Rz @ Ry @ Rx, [dRz @ Ry @ Rx, Rz @ dRy @ Rx, Rz @ Ry @ dRx]


def _about(axis: int, angle_rad: float) -> tuple[FloatArray, FloatArray]:
    """The rotation about an axis of the frame, and its derivative."""
    u, v = (axis + 1) % 3, (axis + 2) % 3
    R, slope = np.eye(3), np.zeros((3, 3))
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    R[u, u], R[v, v], R[v, u], R[u, v] = c, c, s, -s
    slope[u, u], slope[v, v], slope[v, u], slope[u, v] = -s, -s, c, -c
    return R, slope
