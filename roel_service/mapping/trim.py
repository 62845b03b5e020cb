"""Infinite lines cut to the segments that were seen, without those that cannot be trusted.

Paper: end of "Multi-view Line Optimization": the plane through each observed end, across the 2D
segment, cuts the 3D line; two ends are clustered from the cuts of all views (`cluster`).
`coverage` counts instead how many observations cover each piece of the line: a line seen in two
pieces stays two pieces.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roel_service.arrays import BoolArray, FloatArray, IntArray
from roel_service.config.stages import TrimConfig
from roel_service.geometry import plucker
from roel_service.geometry.vectors import dot, norm
from roel_service.mapping import trim_kernels
from roel_service.mapping.frames import Frames
from roel_service.mapping.refine import Refined
from roel_service.mapping.views import Views, cuts_m
from roel_service.scene.lines import InfiniteLines, LineMap, LineTracks
from roel_service.scene.results import TrackStatus

# Part of a line that fewer views than this share of the best piece saw is not looked for again.
SPAN_COVERAGE_FRACTION = 0.25
# Strength of a segment is n sqrt(length) / (this + sigma): below it, sigma does not matter.
SIGMA_FLOOR_M = 0.01
# Without any residual a line would be sure of whatever nothing tells.
LEAST_NOISE_PX = 0.001


@dataclass(frozen=True, eq=False, kw_only=True)
class _Cuts:
    """Where observations begin and end on their line.

    Attributes:
        interval_m: (S, 2) arc lengths, ascending; only rows with a finite cut in front of the
            camera at both ends are kept.
        depth_m: (S,) of the middle.
        row: (S,) the row of the tracks that each belongs to.
    """

    interval_m: FloatArray
    depth_m: FloatArray
    row: IntArray


@dataclass(frozen=True, eq=False, kw_only=True)
class _Segments:
    """Pieces of lines: line (n,), interval_m (n, 2), frame_count (n,)."""

    line: IntArray
    interval_m: FloatArray
    frame_count: IntArray


@dataclass(frozen=True, eq=False, kw_only=True)
class ObservedPieces:
    """Pieces of lines that were seen, certain or not.

    Attributes:
        line: (n,) which line each is a piece of.
        ends: (n, 2, 3) m, world.
        sigma_m: (n,) standard deviation of the worse end across the line, as of a line map.
    """

    line: IntArray
    ends: FloatArray
    sigma_m: FloatArray


def trim_to_segments(
    refined: Refined, views: Views, frames: Frames, config: TrimConfig
) -> tuple[LineMap, list[TrackStatus]]:
    """Cut, judge and de-duplicate the lines.

    Returns:
        The line map, and the status of each line that did not enter it.
    """
    pieces = _pieces(refined, views, frames, config)
    dropped = [TrackStatus.TOO_SHORT] * (len(refined) - len(np.unique(pieces.line)))
    sigma_m = _sigma_m(refined, pieces)
    support = _support_ratio(refined, pieces, frames)
    error_m = _expected_error_m(sigma_m, refined.rms_px[pieces.line], support)
    certain = error_m <= config.max_error_m
    dropped += [TrackStatus.UNCERTAIN] * int((~certain).sum())
    return _line_map(refined, pieces, sigma_m, certain, config), dropped


def observed_pieces(
    refined: Refined, views: Views, frames: Frames, config: TrimConfig
) -> ObservedPieces:
    """The pieces that would enter the map if they were certain enough."""
    pieces = _pieces(refined, views, frames, config)
    return ObservedPieces(
        line=pieces.line, ends=_ends(refined, pieces), sigma_m=_sigma_m(refined, pieces)
    )


def _pieces(refined: Refined, views: Views, frames: Frames, config: TrimConfig) -> _Segments:
    cuts = _cuts(refined.lines, refined.tracks, views)
    if config.method == "cluster":
        return _clustered(refined, cuts, views, frames, config)
    return _covered(refined, cuts, views, frames, config)


def _support_ratio(refined: Refined, pieces: _Segments, frames: Frames) -> FloatArray:
    """(n,) frames that saw a piece against frames that could have."""
    return pieces.frame_count / np.maximum(_frames_in_view(refined, pieces, frames), 1)


def _expected_error_m(sigma_m: FloatArray, rms_px: FloatArray, support: FloatArray) -> FloatArray:
    """(n,) how far off the worse end of a piece is thought to be.

    Its standard deviation is taken for the line's own noise. Observations that are of no one edge may
    agree with one another all the same, so what few frames saw, of those that could, is trusted less.
    """
    return sigma_m * np.maximum(rms_px, LEAST_NOISE_PX) / support


def covered_spans(lines: InfiniteLines, tracks: LineTracks, views: Views) -> FloatArray:
    """(L, 2) from the first to the last arc length, m, that enough views cover; NaN without any."""
    cuts = _cuts(lines, tracks, views)
    line_of = tracks.track_of_row[cuts.row]
    offsets = np.searchsorted(line_of, np.arange(len(lines) + 1))
    return np.asarray(trim_kernels.covered_spans(cuts.interval_m, offsets, SPAN_COVERAGE_FRACTION))


def _cuts(lines: InfiniteLines, tracks: LineTracks, views: Views) -> _Cuts:
    line = tracks.track_of_row
    arc_m, depth_m = cuts_m(
        views.take(tracks.observation), lines.direction[line], lines.moment[line]
    )
    usable = np.isfinite(arc_m).all(axis=1) & (depth_m > 0).all(axis=1)
    return _Cuts(
        interval_m=np.sort(arc_m[usable], axis=1),
        depth_m=depth_m[usable].mean(axis=1),
        row=np.flatnonzero(usable),
    )


def _groups(line_of: IntArray, line_count: int) -> list[tuple[int, slice]]:
    """(line, its rows) for every line with rows; `line_of` is ascending."""
    bounds = np.searchsorted(line_of, np.arange(line_count + 1))
    return [
        (line, slice(int(bounds[line]), int(bounds[line + 1])))
        for line in range(line_count)
        if bounds[line] < bounds[line + 1]
    ]


def _coverage(interval_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Ends (n + 1,) of the elementary pieces of a line, and how many intervals cover each (n,)."""
    ends = np.unique(interval_m)
    change = np.zeros(len(ends))
    np.add.at(change, np.searchsorted(ends, interval_m[:, 0]), 1.0)
    np.add.at(change, np.searchsorted(ends, interval_m[:, 1]), -1.0)
    return ends, np.cumsum(change)[:-1]


def _covered(
    refined: Refined, cuts: _Cuts, views: Views, frames: Frames, config: TrimConfig
) -> _Segments:
    """Runs that enough observations cover; short gaps are bridged, long ones part the line."""
    cuts = _not_end_on(cuts, refined.tracks, views, frames, config.max_foreshortening)
    line_of = refined.tracks.track_of_row[cuts.row]
    frame_of = views.frame[refined.tracks.observation[cuts.row]]
    lines, intervals, counts = [], [], []
    for line, rows in _groups(line_of, len(refined)):
        ends, coverage = _coverage(cuts.interval_m[rows])
        needed = max(config.min_coverage_count, config.min_coverage_fraction * coverage.max())
        pixel_m = float(np.median(cuts.depth_m[rows])) / frames.focal_px
        max_gap_m = max(config.max_gap_m, config.min_pixel_gap_px * pixel_m)
        for start_m, stop_m in _runs(ends, coverage >= needed, max_gap_m):
            if stop_m - start_m < config.min_length_m:
                continue
            overlaps = (cuts.interval_m[rows, 0] < stop_m) & (cuts.interval_m[rows, 1] > start_m)
            lines.append(line)
            intervals.append((start_m, stop_m))
            counts.append(len(np.unique(frame_of[rows][overlaps])))
    return _segments(lines, intervals, counts)


def _not_end_on(
    cuts: _Cuts, tracks: LineTracks, views: Views, frames: Frames, max_foreshortening: float
) -> _Cuts:
    """The cuts without those of views along the line, where a pixel is a long way on it."""
    length_px = views.length_px[tracks.observation[cuts.row]]
    across_m = length_px * cuts.depth_m / frames.focal_px
    along_m = cuts.interval_m[:, 1] - cuts.interval_m[:, 0]
    kept = along_m <= max_foreshortening * across_m
    return _Cuts(interval_m=cuts.interval_m[kept], depth_m=cuts.depth_m[kept], row=cuts.row[kept])


def _runs(ends: FloatArray, covered: BoolArray, max_gap_m: float) -> list[tuple[float, float]]:
    """Covered pieces joined over gaps of at most `max_gap_m`."""
    runs: list[tuple[float, float]] = []
    for piece in np.flatnonzero(covered):
        start_m, stop_m = float(ends[piece]), float(ends[piece + 1])
        if runs and start_m - runs[-1][1] <= max_gap_m:
            runs[-1] = (runs[-1][0], stop_m)
        else:
            runs.append((start_m, stop_m))
    return runs


def _clustered(
    refined: Refined, cuts: _Cuts, views: Views, frames: Frames, config: TrimConfig
) -> _Segments:
    """One segment a line: the largest cluster of starts and the largest cluster of stops."""
    line_of = refined.tracks.track_of_row[cuts.row]
    frame_of = views.frame[refined.tracks.observation[cuts.row]]
    lines, intervals, counts = [], [], []
    for line, rows in _groups(line_of, len(refined)):
        radius_m = config.end_cluster_px * float(np.median(cuts.depth_m[rows])) / frames.focal_px
        start_m, stop_m = (_largest_cluster(ends, radius_m) for ends in cuts.interval_m[rows].T)
        if stop_m - start_m < config.min_length_m:
            continue
        lines.append(line)
        intervals.append((start_m, stop_m))
        counts.append(len(np.unique(frame_of[rows])))
    return _segments(lines, intervals, counts)


def _largest_cluster(positions_m: FloatArray, radius_m: float) -> float:
    """Median of the largest group of positions whose neighbours are within `radius_m`."""
    ordered = np.sort(positions_m)
    groups = np.split(ordered, np.flatnonzero(np.diff(ordered) > radius_m) + 1)
    return float(np.median(max(groups, key=len)))


def _segments(
    lines: list[int], intervals: list[tuple[float, float]], counts: list[int]
) -> _Segments:
    return _Segments(
        line=np.array(lines, dtype=np.int64),
        interval_m=np.array(intervals, dtype=np.float64).reshape(-1, 2),
        frame_count=np.array(counts, dtype=np.int64),
    )


def _sigma_m(refined: Refined, pieces: _Segments) -> FloatArray:
    """(n,) standard deviation of the worse end across the line, for 1 px of noise an observation.

    It orders lines; measured errors are smaller, as observations are better than a pixel.
    """
    direction = refined.lines.direction
    moment = plucker.shift_origin(direction, refined.lines.moment, refined.origin)
    dv, dm = refined.jacobians()
    by_foot = np.cross(dv, moment[..., None], axis=-2) + np.cross(direction[..., None], dm, axis=-2)
    covariance = refined.covariance
    line = pieces.line
    about_origin = pieces.interval_m - dot(direction, refined.origin)[line, None]
    worst: FloatArray = np.zeros(len(line))
    for end in range(2):
        by_end = by_foot[line] + about_origin[:, end, None, None] * dv[line]
        spread = by_end @ covariance[line] @ np.swapaxes(by_end, -1, -2)
        across = np.eye(3) - direction[line, :, None] * direction[line, None, :]
        variance = np.linalg.eigvalsh(across @ spread @ across)[:, -1]
        worst = np.maximum(worst, variance)
    return np.asarray(np.sqrt(worst))


def _ends(refined: Refined, pieces: _Segments) -> FloatArray:
    """(n, 2, 3) ends of the pieces, m, world."""
    lines = refined.lines
    return plucker.endpoints_from_plucker(
        lines.direction[pieces.line], lines.moment[pieces.line], pieces.interval_m
    )


def _frames_in_view(refined: Refined, pieces: _Segments, frames: Frames) -> IntArray:
    """(n,) frames that have the middle of each piece in their image; occlusion is not known."""
    middles = _ends(refined, pieces).mean(axis=1)
    counts: IntArray = np.zeros(len(middles), dtype=np.int64)
    size_px = np.array([frames.width, frames.height])
    for frame in range(len(frames)):
        in_camera = frames.T_world_camera[frame].inverse() @ middles
        homogeneous = in_camera @ frames.K.T
        depth_m = homogeneous[:, 2:]
        # Compared without a division, so that points behind the camera need no care.
        inside = (homogeneous[:, :2] >= 0) & (homogeneous[:, :2] < size_px * depth_m)
        counts = counts + (inside.all(axis=1) & (depth_m[:, 0] > 0))
    return counts


def _line_map(
    refined: Refined, pieces: _Segments, sigma_m: FloatArray, certain: BoolArray, config: TrimConfig
) -> LineMap:
    """The certain pieces, strongest first, without what lies along a stronger one."""
    ends = _ends(refined, pieces)
    root_length = np.sqrt(norm(ends[:, 1] - ends[:, 0]))
    strength = pieces.frame_count.astype(np.float64) * root_length / (SIGMA_FLOOR_M + sigma_m)
    order = np.argsort(-strength, kind="stable")
    order = order[certain[order]]
    segments, source = _without_overlaps(ends[order], config)
    origin = order[source]
    return LineMap(
        segments=segments,
        observation_count=pieces.frame_count[origin],
        rms_residual_px=refined.rms_px[pieces.line[origin]],
        sigma_m=sigma_m[origin],
    )


def _without_overlaps(segments: FloatArray, config: TrimConfig) -> tuple[FloatArray, IntArray]:
    """Cut from each segment what lies along one before it.

    Args:
        segments: (n, 2, 3) m, strongest first.

    Returns:
        (k, 2, 3) what is left, at least `min_length_m` long each, and (k,) which segment it is of.
    """
    min_cosine = np.cos(np.deg2rad(config.overlap_angle_deg))
    length_m = norm(segments[:, 1] - segments[:, 0])
    direction = (segments[:, 1] - segments[:, 0]) / length_m[:, None]
    left, source = [np.empty((0, 2, 3))], []
    for i, (start, end) in enumerate(segments):
        parallel = np.abs(direction[:i] @ direction[i]) > min_cosine
        hidden = _shares_along(
            segments[i], segments[:i][parallel], direction[:i][parallel], config.overlap_distance_m
        )
        for low, high in _remaining(hidden):
            if (high - low) * length_m[i] >= config.min_length_m:
                left.append((start + np.array([[low], [high]]) * (end - start))[None])
                source.append(i)
    return np.concatenate(left), np.array(source, dtype=np.int64)


def _shares_along(
    segment: FloatArray, others: FloatArray, directions: FloatArray, max_distance_m: float
) -> FloatArray:
    """(n, 2) which shares [low, high] of a segment lie along each of (n, 2, 3) others.

    Distance and position are linear along the segment: both conditions are intervals of it.
    """
    offset = segment[0] - others[:, 0]
    step = segment[1] - segment[0]
    # Where the foot falls within the other segment.
    at_start, rate = dot(offset, directions), directions @ step
    length_m = norm(others[:, 1] - others[:, 0])
    rate = np.where(rate == 0, 1e-300, rate)
    within = np.sort(np.stack([-at_start / rate, (length_m - at_start) / rate], axis=1), axis=1)
    # Where the distance stays below the limit: |p + t q|^2 <= d^2.
    p = offset - at_start[:, None] * directions
    q = step - (directions @ step)[:, None] * directions
    a, b, c = dot(q, q), dot(p, q), dot(p, p) - max_distance_m**2
    a = np.maximum(a, 1e-300)
    root = np.sqrt(np.where(b**2 >= a * c, b**2 - a * c, np.nan))
    close = np.stack([(-b - root) / a, (-b + root) / a], axis=1)
    low = np.maximum.reduce([within[:, 0], close[:, 0], np.zeros(len(others))])
    high = np.minimum.reduce([within[:, 1], close[:, 1], np.ones(len(others))])
    return np.asarray(np.stack([low, high], axis=1)[low < high])


def _remaining(hidden: FloatArray) -> list[tuple[float, float]]:
    """What is left of [0, 1] without the (n, 2) hidden intervals."""
    left, reached = [], 0.0
    for low, high in hidden[np.argsort(hidden[:, 0])]:
        if low > reached:
            left.append((reached, float(low)))
        reached = max(reached, float(high))
    if reached < 1.0:
        left.append((reached, 1.0))
    return left
