"""Orientations: shared directions of a picture laid on those of a map."""

from __future__ import annotations

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.config.stages import LocalizeConfig
from roel_service.geometry.se3 import rotation_angle, rotation_from_vector
from roel_service.geometry.vectors import any_normal, unit
from roel_service.pano_loc.arcs import PanoramaArcs
from roel_service.pano_loc.directions import vanishing_directions
from roel_service.pano_loc.hints import Gravity, PosePrior
from roel_service.pano_loc.prepare import PreparedMap

# Angles between directions agree this closely when one pair may be the other.
PAIR_TOLERANCE_RAD = np.deg2rad(3.0)
# Directions closer than this fix no rotation.
MIN_PAIR_RAD = np.deg2rad(15.0)
# Orientations are scored by the arcs they explain: so many of them, this closely.
SCORED_ARC_COUNT = 300
EXPLAINED_RAD = np.deg2rad(2.0)
# Of orientations this close the better one stays; those explaining less than this share of the
# best go.
SAME_ROTATION_RAD = np.deg2rad(4.0)
MIN_EXPLAINED_SHARE = 0.6
# Widths of the kernel while an orientation is refined.
REFINE_WIDTHS_RAD = np.deg2rad([4.0, 3.0, 2.0, 1.5, 1.0, 1.0])
# Around a single direction every orientation is tried in such steps.
TURN_STEP_RAD = np.deg2rad(4.5)


def rotation_hypotheses(
    arcs: PanoramaArcs,
    prepared: PreparedMap,
    config: LocalizeConfig,
    prior: PosePrior | None = None,
    gravity: Gravity | None = None,
) -> FloatArray:
    """(R, 3, 3) rotations R_world_panorama that lay the picture's directions on the map's.

    With a prior, those near it, and its own.
    """
    seen = vanishing_directions(arcs)
    max_count = config.max_rotation_count
    rotations = _aligned_pairs(seen, prepared.shared)
    if len(rotations) == 0:
        rotations = _aligned_singles(seen, prepared)
        # None of them is more likely than the others.
        max_count = max(max_count, len(rotations))
    if prior is not None:
        first = prior.T_world_picture.rotation
        near = rotations[rotation_angle(rotations @ first.T) < prior.reach_rad]
        rotations = np.concatenate([near, first[None]])
    if gravity is not None:
        rotations = rotations[gravity.agrees(rotations)]
    if len(rotations) == 0:
        return rotations
    few = arcs.take(np.arange(min(len(arcs), SCORED_ARC_COUNT)))
    explained = _explained(rotations, few, prepared.shared)
    rotations, explained = _distinct(rotations, explained, max_count)
    rotations = _refined(rotations, few, prepared.shared)
    explained = _explained(rotations, few, prepared.shared)
    rotations, explained = _distinct(rotations, explained, max_count)
    return np.asarray(rotations[explained >= MIN_EXPLAINED_SHARE * explained[0]])


def _aligned_pairs(seen: FloatArray, shared: FloatArray) -> FloatArray:
    """Rotations that lay two seen directions on two of the map's, with all signs."""
    rotations = []
    between_rad = np.arccos(np.clip(shared @ shared.T, -1.0, 1.0))
    pairs = np.argwhere(~np.eye(len(shared), dtype=bool))
    targets = np.array([_frame(shared[k], shared[m]) for k, m in pairs]).reshape(-1, 3, 3)
    target_rad = between_rad[tuple(pairs.T)]
    for i, j in zip(*np.triu_indices(len(seen), k=1), strict=True):
        for sign in (1.0, -1.0):
            first, second = seen[i], sign * seen[j]
            angle_rad = np.arccos(np.clip(first @ second, -1.0, 1.0))
            if not MIN_PAIR_RAD < angle_rad < np.pi - MIN_PAIR_RAD:
                continue
            alike = targets[np.abs(target_rad - angle_rad) <= PAIR_TOLERANCE_RAD]
            for ahead in (_frame(first, second), _frame(-first, -second)):
                rotations.append(alike.transpose(0, 2, 1) @ ahead)
    return np.concatenate([np.empty((0, 3, 3)), *rotations])


def _frame(first: FloatArray, second: FloatArray) -> FloatArray:
    """(3, 3) rotation with rows along the bisector, across it, and normal to both."""
    ahead, across = unit(first + second), unit(first - second)
    return np.stack([ahead, across, np.cross(ahead, across)])


def _aligned_singles(seen: FloatArray, prepared: PreparedMap) -> FloatArray:
    """Rotations that lay the strongest seen direction on the map's, turned about it in steps."""
    if len(seen) == 0 or len(prepared.shared) == 0:
        return np.empty((0, 3, 3))
    axis = prepared.frame[0]
    turns = rotation_from_vector(np.arange(0.0, 2.0 * np.pi, TURN_STEP_RAD)[:, None] * axis)
    return np.concatenate(
        [turns @ prepared.frame.T @ _basis(sign * seen[0]) for sign in (1.0, -1.0)]
    )


def _basis(direction: FloatArray) -> FloatArray:
    """(3, 3) rotation whose first row is the unit direction."""
    across = any_normal(direction)
    return np.stack([direction, across, np.cross(direction, across)])


def _explained(rotations: FloatArray, arcs: PanoramaArcs, shared: FloatArray) -> FloatArray:
    """(R,) length of the arcs that have one of the map's directions."""
    directions = np.einsum("rij,ki->rkj", rotations, shared)
    sine = np.abs(np.einsum("rkj,aj->rka", directions, arcs.normals)).min(axis=1)
    return np.asarray(np.exp(-0.5 * (sine / np.sin(EXPLAINED_RAD)) ** 2) @ arcs.length_rad)


def _distinct(
    rotations: FloatArray, explained: FloatArray, max_count: int
) -> tuple[FloatArray, FloatArray]:
    """The best rotations, each the only one of its neighbourhood, best first."""
    left = np.argsort(-explained, kind="stable")
    kept: list[int] = []
    while len(left) and len(kept) < max_count:
        kept.append(int(left[0]))
        turned_rad = rotation_angle(rotations[left] @ rotations[left[0]].T)
        left = left[turned_rad >= SAME_ROTATION_RAD]
    return rotations[kept], explained[kept]


def _refined(rotations: FloatArray, arcs: PanoramaArcs, shared: FloatArray) -> FloatArray:
    """Rotations after robust least squares of (R n) . d over arcs n and their directions d."""
    for width_rad in REFINE_WIDTHS_RAD:
        world = arcs.normals @ rotations.transpose(0, 2, 1)
        sine = world @ shared.T
        nearest = np.abs(sine).argmin(axis=2)
        residual = np.take_along_axis(sine, nearest[:, :, None], axis=2)[:, :, 0]
        jacobian = np.cross(world, shared[nearest])
        weight = arcs.length_rad / (1.0 + (residual / np.sin(width_rad)) ** 2) ** 2
        weighted = (weight[:, :, None] * jacobian).transpose(0, 2, 1)
        H, g = weighted @ jacobian, (weighted @ residual[:, :, None])[:, :, 0]
        damping = 1e-6 * np.trace(H, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        step = -np.linalg.solve(H + damping, g[:, :, None])[:, :, 0]
        rotations = rotation_from_vector(step) @ rotations
    return rotations
