"""Poses made exact: rotation and translation jointly, over matches of arcs with map lines."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from roel_service.arrays import BoolArray, FloatArray, IntArray
from roel_service.geometry.se3 import SE3, rotation_angle
from roel_service.geometry.vectors import unit
from roel_service.pano_loc import refine_kernels
from roel_service.pano_loc.arcs import THREAD_COUNT, PanoramaArcs
from roel_service.pano_loc.coverage import (
    CROWD_REACH_RAD,
    GATE_RAD,
    LinePoints,
    covered,
    credit,
    two_way_score,
)
from roel_service.pano_loc.prepare import PreparedMap
from roel_service.pano_loc.search import Candidates

# A step goes no farther; beyond it the residuals are not linear.
MAX_SHIFT_M = 0.3
MAX_TURN_RAD = np.deg2rad(8.0)
DAMPING = 1e-3
# Least squares: distance of samples, gate between arc and line, kernel width of each iteration.
FINAL_STEP_RAD = np.deg2rad(3.0)
FINAL_GATE_RAD = np.deg2rad(5.0)
FINAL_WIDTHS_RAD = np.deg2rad([0.7] + [0.5] * 7)
# Steps smaller than this, rad and m, are the last one.
CONVERGED = 1e-4
# The same for more of the modes, on fewer arcs.
MODE_COUNT, MODE_WIDTHS_RAD = 24, np.deg2rad([3.0, 2.0, 1.5, 1.0, 0.7])
MODE_ARC_COUNT, MODE_LINE_COUNT, MODE_STEP_RAD = 200, 600, np.deg2rad(6.0)
# So many of them are made exact, told apart by points of about so many lines of all lengths.
FINALIST_COUNT, WEIGHED_LINE_COUNT, WEIGHED_SPACING_M = 6, 800, 0.3
# Within reach of a prior few poses are apart from one another.
PRIOR_MODE_COUNT, PRIOR_FINALIST_COUNT = 8, 3
# Lines near an arc are looked for once for each pose: while it is refined they move by less.
FINAL_SLACK_RAD, MODE_SLACK_RAD = np.deg2rad(3.0), np.deg2rad(5.0)
# Poses closer than this in both are one.
SAME_POSE_M, SAME_POSE_RAD = 0.25, np.deg2rad(8.0)
# Before they are refined, poses that are a little apart may end apart.
UNREFINED_SHARE = 0.5


# Offsets (A + 1,) and indices of the lines near each arc.
Nearby = tuple[IntArray, IntArray]


@dataclass(frozen=True, eq=False, kw_only=True)
class Samples:
    """Rays along the arcs, at about equal angles.

    Attributes:
        rays: (S, 3) unit, panorama frame; those of arc a are offsets[a]:offsets[a + 1].
        offsets: (A + 1,).
        weight: (S,) angle that each stands for, rad.
        normals, middles: (A, 3) unit, of the arcs.
        reach_rad: (A,) half their lengths.
    """

    rays: FloatArray
    offsets: IntArray
    weight: FloatArray
    normals: FloatArray
    middles: FloatArray
    reach_rad: FloatArray


def sample_arcs(arcs: PanoramaArcs, step_rad: float) -> Samples:
    """At least two rays an arc, in the middles of equal parts."""
    counts = np.maximum(np.ceil(arcs.length_rad / step_rad), 2).astype(np.int64)
    arc = np.repeat(np.arange(len(arcs)), counts)
    offsets = np.concatenate([[0], np.cumsum(counts)])
    share = (np.arange(len(arc)) - offsets[arc] + 0.5) / counts[arc]
    turn_rad = (share * arcs.length_rad[arc])[:, None]
    aside = np.cross(arcs.normals, arcs.starts)
    return Samples(
        rays=np.cos(turn_rad) * arcs.starts[arc] + np.sin(turn_rad) * aside[arc],
        offsets=offsets,
        weight=arcs.length_rad[arc] / counts[arc],
        normals=arcs.normals,
        middles=unit(arcs.starts + arcs.ends),
        reach_rad=arcs.length_rad / 2,
    )


def refine_poses(
    candidates: Candidates,
    arcs: PanoramaArcs,
    prepared: PreparedMap,
    *,
    has_prior: bool = False,
) -> Candidates:
    """Modes of the best fit, best first; each scored by the share of the arcs that it explains."""
    mode_count, finalist_count = MODE_COUNT, FINALIST_COUNT
    if has_prior:
        mode_count, finalist_count = PRIOR_MODE_COUNT, PRIOR_FINALIST_COUNT
    few = sample_arcs(arcs.take(np.arange(min(len(arcs), MODE_ARC_COUNT))), MODE_STEP_RAD)
    modes = _refined(
        distinct(candidates, mode_count, UNREFINED_SHARE),
        few,
        prepared,
        MODE_WIDTHS_RAD,
        MODE_SLACK_RAD,
        MODE_LINE_COUNT,
    )
    if len(modes) > finalist_count:
        modes = _weighed(modes, arcs, prepared)
    best = distinct(modes, finalist_count)
    samples = sample_arcs(arcs, FINAL_STEP_RAD)
    refined = _refined(best, samples, prepared, FINAL_WIDTHS_RAD, FINAL_SLACK_RAD, len(prepared))
    return distinct(refined, finalist_count)


def _weighed(modes: Candidates, arcs: PanoramaArcs, prepared: PreparedMap) -> Candidates:
    """Modes scored in both directions: a map of many rooms explains much of any picture."""
    stride = -(-len(prepared) // WEIGHED_LINE_COUNT)
    lines = LinePoints.of(prepared.segments[::stride], WEIGHED_SPACING_M)

    def score(index: int) -> float:
        shown = covered(modes.poses[index], arcs, lines)
        return two_way_score(float(modes.score[index]), shown)

    with ThreadPoolExecutor(THREAD_COUNT) as threads:
        return Candidates(
            poses=modes.poses, score=np.array(list(threads.map(score, range(len(modes)))))
        )


def distinct(candidates: Candidates, max_count: int, share: float = 1.0) -> Candidates:
    """The best candidates, each the only one of its neighbourhood, best first.

    Args:
        share: of the distances at which poses are one.
    """
    candidates = candidates.ranked()
    poses = candidates.poses
    kept: list[int] = []
    for index in range(len(candidates)):
        if len(kept) == max_count:
            break
        shift_m = np.linalg.norm(poses.translation[kept] - poses.translation[index], axis=1)
        turn_rad = rotation_angle(poses.rotation[kept] @ poses.rotation[index].T)
        if not ((shift_m < share * SAME_POSE_M) & (turn_rad < share * SAME_POSE_RAD)).any():
            kept.append(index)
    return candidates.take(np.array(kept, dtype=np.int64))


def _refined(
    candidates: Candidates,
    samples: Samples,
    prepared: PreparedMap,
    widths_rad: FloatArray,
    slack_rad: float,
    line_count: int,
) -> Candidates:
    """Each candidate after robust least squares over rotation and place.

    Args:
        candidates: first poses.
        samples: of the arcs.
        prepared: the map.
        widths_rad: of the kernel, in each iteration.
        slack_rad: lines are looked for near arcs once, with so much to spare.
        line_count: that take part, those that are widest from a pose.
    """

    def refined(pose: SE3) -> tuple[SE3, float]:
        lines = prepared.widest(pose.translation, line_count)
        max_residual_rad = refine_kernels.CUTOFF_WIDTHS * widths_rad[0]
        nearby = lines_nearby(pose, samples, lines, max_residual_rad, slack_rad)
        for width_rad in widths_rad:
            found = match(pose, samples, lines, nearby, FINAL_GATE_RAD)
            step = _step(*equations(found, samples, lines, width_rad))
            pose = pose.retract(step)
            if width_rad == widths_rad[-1] and np.linalg.norm(step) < CONVERGED:
                break
        return pose, explained(pose, samples, lines, nearby)

    with ThreadPoolExecutor(THREAD_COUNT) as threads:
        found = list(threads.map(refined, (candidates.poses[i] for i in range(len(candidates)))))
    return Candidates(
        poses=SE3(
            rotation=np.array([pose.rotation for pose, _ in found]).reshape(-1, 3, 3),
            translation=np.array([pose.translation for pose, _ in found]).reshape(-1, 3),
        ),
        score=np.array([score for _, score in found]),
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class Matches:
    """Rays of a picture in the world's frame, and the lines that they lie on.

    Attributes:
        rays: (S, 3) unit.
        seen: the lines from the pose's place.
        line: (S,) index, -1 for none.
        residual: (S,) sine of the angle between ray and line.
    """

    rays: FloatArray
    seen: tuple[FloatArray, FloatArray, FloatArray, FloatArray, BoolArray]
    line: IntArray
    residual: FloatArray


def lines_nearby(
    pose: SE3,
    samples: Samples,
    prepared: PreparedMap,
    max_residual_rad: float,
    slack_rad: float = 0.0,
) -> Nearby:
    """Lines that rays of each arc may lie on at this pose, and at others that are close to it.

    Args:
        max_residual_rad: rays that are farther off a line do not count.
        slack_rad: how much closer they may come at the other poses.
    """
    return refine_kernels.nearby_lines(
        samples.middles @ pose.rotation.T,
        samples.reach_rad,
        samples.normals @ pose.rotation.T,
        prepared.directions,
        refine_kernels.viewed_lines(prepared.segments, pose.translation),
        GATE_RAD,
        max_residual_rad,
        slack_rad,
    )


def match(
    pose: SE3, samples: Samples, prepared: PreparedMap, nearby: Nearby, max_angle_rad: float
) -> Matches:
    """The nearest line of each ray, among those that the arc may be."""
    rays, normals = samples.rays @ pose.rotation.T, samples.normals @ pose.rotation.T
    seen = refine_kernels.viewed_lines(prepared.segments, pose.translation)
    line, residual = refine_kernels.match_rays(
        rays, samples.offsets, normals, prepared.directions, seen, nearby, max_angle_rad
    )
    return Matches(rays=rays, seen=seen, line=line, residual=residual)


def equations(
    found: Matches, samples: Samples, prepared: PreparedMap, width_rad: float
) -> tuple[FloatArray, FloatArray]:
    """(6, 6) of the Gauss-Newton step at a pose, and (L, 6) gradient by line; tangent (r, d)."""
    H, g = refine_kernels.normal_equations(
        found.rays,
        samples.weight,
        prepared.segments,
        found.seen,
        found.line,
        found.residual,
        width_rad,
    )
    return H, g


def explained(pose: SE3, samples: Samples, prepared: PreparedMap, nearby: Nearby) -> float:
    """Share of the arcs' length that lines of the map explain, 0 to 1.

    Args:
        nearby: lines that are closer than `CROWD_REACH_RAD`; of fewer, crowds look smaller.
    """
    off, crowd = refine_kernels.crowd_on_rays(
        samples.rays @ pose.rotation.T,
        samples.offsets,
        samples.normals @ pose.rotation.T,
        prepared.directions,
        refine_kernels.viewed_lines(prepared.segments, pose.translation),
        nearby,
        GATE_RAD,
        CROWD_REACH_RAD,
    )
    return float(samples.weight @ credit(off, crowd) / max(samples.weight.sum(), 1e-9))


def _step(H: FloatArray, gradients: FloatArray) -> FloatArray:
    """(6,) damped step, shortened to what stays linear."""
    g = gradients.sum(axis=0)
    damping = DAMPING * np.diag(np.maximum(np.diag(H), 1e-9))
    step = -np.linalg.solve(H + damping, g)
    shrink = max(
        1.0,
        float(np.linalg.norm(step[:3])) / MAX_TURN_RAD,
        float(np.linalg.norm(step[3:])) / MAX_SHIFT_M,
    )
    return np.asarray(step / shrink)
