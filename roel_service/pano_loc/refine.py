"""Poses made exact: rotation and translation jointly, over matches of arcs with map lines."""

from __future__ import annotations

import numpy as np

from roel_service.arrays import Array, FloatArray
from roel_service.geometry.se3 import SE3, rotation_angle
from roel_service.geometry.vectors import unit
from roel_service.pano_loc import refine_kernels
from roel_service.pano_loc.arcs import PanoramaArcs
from roel_service.pano_loc.coverage import (
    CROWD_REACH_RAD,
    GATE_RAD,
    covered,
    credit,
    line_points,
    two_way_score,
)
from roel_service.pano_loc.prepare import PreparedMap
from roel_service.pano_loc.search import Candidates
from roel_service.pano_loc.side_by_side import side_by_side
from roel_service.pano_loc.sight_kernels import Samples

# Least squares: distance of samples, gate between arc and line, kernel width of each iteration.
FINAL_STEP_RAD = np.deg2rad(3.0)
FINAL_GATE_RAD = np.deg2rad(5.0)
FINAL_WIDTHS_RAD = np.deg2rad([0.7] + [0.5] * 7)
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


def sample_arcs(arcs: PanoramaArcs, step_rad: float) -> Samples:
    """At least two rays an arc, in the middles of equal parts."""
    counts = np.maximum(np.ceil(arcs.length_rad / step_rad), 2).astype(np.int64)
    arc = np.repeat(np.arange(len(arcs)), counts)
    offsets = np.concatenate([[0], np.cumsum(counts)])
    share = (np.arange(len(arc)) - offsets[arc] + 0.5) / counts[arc]
    from_middle_rad = (share - 0.5) * arcs.length_rad[arc]
    middles, reach_rad = unit(arcs.starts + arcs.ends), arcs.length_rad / 2
    return Samples(
        normals=arcs.normals.copy(),
        middles=middles,
        asides=np.cross(arcs.normals, middles),
        columns=np.stack(
            [*arcs.normals.T, *middles.T, np.cos(reach_rad), np.sin(reach_rad)], dtype=np.float32
        ),
        reach_rad=reach_rad,
        offsets=offsets,
        cosine=np.cos(from_middle_rad),
        sine=np.sin(from_middle_rad),
        weight=arcs.length_rad[arc] / counts[arc],
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
    samples = sample_arcs(arcs, FINAL_STEP_RAD)
    modes = _refined(
        distinct(candidates, mode_count, UNREFINED_SHARE),
        few,
        prepared,
        MODE_WIDTHS_RAD,
        MODE_SLACK_RAD,
        MODE_LINE_COUNT,
    )
    if len(modes) > finalist_count:
        modes = _weighed(modes, samples, arcs.sides, prepared)
    best = distinct(modes, finalist_count)
    refined = _refined(best, samples, prepared, FINAL_WIDTHS_RAD, FINAL_SLACK_RAD, len(prepared))
    return distinct(refined, finalist_count)


def _weighed(
    modes: Candidates, samples: Samples, sides: FloatArray, prepared: PreparedMap
) -> Candidates:
    """Modes scored in both directions: a map of many rooms explains much of any picture."""
    stride = -(-len(prepared) // WEIGHED_LINE_COUNT)
    lines = line_points(prepared.segments[::stride], WEIGHED_SPACING_M)

    def score(index: int) -> float:
        shown = covered(modes.poses[index], samples, sides, lines)
        return two_way_score(float(modes.score[index]), shown)

    return Candidates(poses=modes.poses, score=np.array(side_by_side(score, range(len(modes)))))


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
        lines = refine_kernels.widest(prepared.segments, pose.translation, line_count)
        rotation, place, off, crowd = refine_kernels.refined(
            lines,
            pose.rotation,
            pose.translation,
            samples,
            widths_rad,
            FINAL_GATE_RAD,
            slack_rad,
            GATE_RAD,
            CROWD_REACH_RAD,
        )
        return SE3(rotation=rotation, translation=place), explained(samples, off, crowd)

    found = side_by_side(refined, (candidates.poses[i] for i in range(len(candidates))))
    return Candidates(
        poses=SE3(
            rotation=np.array([pose.rotation for pose, _ in found]).reshape(-1, 3, 3),
            translation=np.array([pose.translation for pose, _ in found]).reshape(-1, 3),
        ),
        score=np.array([score for _, score in found]),
    )


def explained(samples: Samples, off: FloatArray, crowd: Array) -> float:
    """Share of the arcs' length that lines of the map explain, 0 to 1.

    Args:
        samples: of the arcs.
        off: (S,) sine of the angle from each ray to the nearest line, which may be infinite.
        crowd: (S,) lines near it.
    """
    return float(samples.weight @ credit(off, crowd) / max(samples.weight.sum(), 1e-9))
