"""Space-time planes through the events near each detected line.

Paper: "Detection-guided Space-time Plane Fitting". The plane refines the line to sub-pixel
accuracy (its slice at the frame's time) and tells which events support it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from roel_service.arrays import Array, FloatArray, IntArray
from roel_service.config.stages import PlaneFitConfig
from roel_service.mapping import detect_kernels, plane_fit_kernels
from roel_service.mapping.detect import Seeds
from roel_service.mapping.frames import UNKNOWN_POLARITY, EventFrame
from roel_service.mapping.plane_fit_direct import fit_clusters
from roel_service.mapping.plane_fit_kernels import Grid, VoteSettings
from roel_service.scene.lines import LineObservations

# Cells of the event grid; about the width that a seed gathers from.
CELL_PX = 8.0


@dataclass(frozen=True, eq=False, kw_only=True)
class FittedLines:
    """Lines of one frame that a plane supports.

    Attributes:
        segments_px: (M, 2, 2) slices of the planes at the frame's time.
        polarity: (M,) int8, -1 or +1, or 0 where both polarities were fitted together.
        normal_speed_px_per_ms: (M,) along the left-hand normal of the segment.
        event_offsets: (M + 1,) int64.
        event_xy_px: (P, 2) float32, supporting events at their own time.
        event_dt_us: (P,) int32, against the frame's time.
    """

    segments_px: FloatArray
    polarity: Array
    normal_speed_px_per_ms: FloatArray
    event_offsets: IntArray
    event_xy_px: Array
    event_dt_us: Array

    def without_events(self) -> FittedLines:
        """The lines alone."""
        return replace(
            self,
            event_offsets=np.zeros(len(self.polarity) + 1, np.int64),
            event_xy_px=np.empty((0, 2), np.float32),
            event_dt_us=np.empty(0, np.int32),
        )


NO_LINES = FittedLines(
    segments_px=np.empty((0, 2, 2)),
    polarity=np.empty(0, np.int8),
    normal_speed_px_per_ms=np.empty(0),
    event_offsets=np.zeros(1, np.int64),
    event_xy_px=np.empty((0, 2), np.float32),
    event_dt_us=np.empty(0, np.int32),
)


def fit_space_time_planes(
    seeds: Seeds, frame: EventFrame, config: PlaneFitConfig, rng: np.random.Generator
) -> FittedLines:
    """Refine the seeds of one frame and find their supporting events.

    Args:
        seeds: detected lines, longest first; `direct` does without them.
        frame: events with the camera's rotation undone.
        rng: draws the planes of `ransac` and `direct`; `vote` is deterministic.
    """
    if config.method == "none":
        return _as_detected(seeds)
    tau_ms = (frame.events.t_us - frame.events.t_ref_us).astype(np.float64) * 1e-3
    grid = _grid(frame, tau_ms)
    if config.method == "vote":
        lines, speeds, polarity = _fit_by_vote(seeds, frame, grid, config)
    elif config.method == "ransac":
        lines, speeds, polarity = _fit_by_ransac(seeds, grid, config, rng)
    else:
        lines, speeds, polarity = _fit_directly(frame, tau_ms, config, rng)
    offsets, chosen = plane_fit_kernels.support(
        lines,
        speeds,
        polarity,
        grid,
        config.inlier_distance_px,
        config.support_half_window_us * 1e-3,
        config.support_event_count,
    )
    return FittedLines(
        segments_px=lines,
        polarity=polarity,
        normal_speed_px_per_ms=speeds,
        event_offsets=offsets,
        event_xy_px=frame.ideal_px[chosen],
        event_dt_us=(frame.events.t_us[chosen] - frame.events.t_ref_us).astype(np.int32),
    )


def _as_detected(seeds: Seeds) -> FittedLines:
    """The seeds themselves: not refined, of unknown speed, without supporting events."""
    return FittedLines(
        segments_px=seeds.segments_px,
        polarity=seeds.polarity,
        normal_speed_px_per_ms=np.zeros(len(seeds)),
        event_offsets=np.zeros(len(seeds) + 1, np.int64),
        event_xy_px=np.empty((0, 2), np.float32),
        event_dt_us=np.empty(0, np.int32),
    )


def _grid(frame: EventFrame, tau_ms: FloatArray) -> Grid:
    rows = int(np.ceil(frame.height / CELL_PX))
    columns = int(np.ceil(frame.width / CELL_PX))
    start, order = plane_fit_kernels.grid_events(
        frame.compensated_px, frame.events.polarity, rows, columns, CELL_PX
    )
    return Grid(
        start=start,
        order=order,
        xy_px=frame.compensated_px.take(order, axis=0),
        tau_ms=tau_ms.take(order),
        rows=rows,
        columns=columns,
        cell_px=CELL_PX,
    )


def _fit_by_vote(
    seeds: Seeds, frame: EventFrame, grid: Grid, config: PlaneFitConfig
) -> tuple[FloatArray, FloatArray, Array]:
    """Speed vote and robust least squares, a polarity at a time; better fits drop duplicates."""
    settings = VoteSettings(
        candidate_distance_px=config.candidate_distance_px,
        extension_px=config.extension_px,
        max_speed_px_per_ms=config.max_speed_widths_per_s * frame.width * 1e-3,
        speed_count=config.speed_count,
        inlier_distance_px=config.inlier_distance_px,
        support_bin_px=config.support_bin_px,
        max_gap_bin_count=config.max_gap_bin_count,
        min_occupancy=config.min_occupancy,
        min_density_ratio=config.min_density_ratio,
    )
    lines, speeds, scores, polarity = plane_fit_kernels.fit_by_vote(
        seeds.segments_px, seeds.polarity, grid, settings
    )
    best = _best_first(lines, scores, polarity, config)
    return lines[best], speeds[best], polarity[best]


def _fit_by_ransac(
    seeds: Seeds,
    grid: Grid,
    config: PlaneFitConfig,
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray, Array]:
    """The paper's fit: every seed gives at most one line, from the events of both polarities."""
    lines, speeds, scores = plane_fit_kernels.fit_by_ransac(
        seeds.segments_px,
        grid,
        rng.random((len(seeds), config.trial_count, 3)),
        config.candidate_distance_px,
        config.time_scale_px_per_ms,
        config.inlier_distance_px,
        config.min_inlier_count,
    )
    polarity = np.full(len(lines), UNKNOWN_POLARITY, np.int8)
    best = _best_first(lines, scores, polarity, config)
    return lines[best], speeds[best], polarity[best]


def _fit_directly(
    frame: EventFrame, tau_ms: FloatArray, config: PlaneFitConfig, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, Array]:
    """A line for each cluster of events of both polarities; the paper's alternative."""
    lines, speeds, scores = fit_clusters(frame.compensated_px, tau_ms, config, rng)
    polarity = np.full(len(lines), UNKNOWN_POLARITY, np.int8)
    best = _best_first(lines, scores, polarity, config)
    return lines[best], speeds[best], polarity[best]


def _best_first(
    lines: FloatArray, scores: FloatArray, polarity: Array, config: PlaneFitConfig
) -> IntArray:
    """Indices of the fitted lines, best first, without those that lie along a better one."""
    order = np.argsort(-scores, kind="stable")
    order = order[scores[order] > 0]
    kept = detect_kernels.keep_first(
        lines[order], polarity[order], config.duplicate_distance_px, config.duplicate_overlap
    )
    return np.asarray(order[kept])


def observations_of_frames(fitted: list[FittedLines]) -> LineObservations:
    """The lines of all frames as one table; list index becomes frame index."""
    counts = [len(lines.polarity) for lines in fitted]
    sizes = [np.diff(lines.event_offsets) for lines in fitted]
    return LineObservations(
        frame=np.repeat(np.arange(len(fitted)), counts),
        segments_px=_joined([lines.segments_px for lines in fitted], (0, 2, 2)),
        polarity=_joined([lines.polarity for lines in fitted], (0,)),
        normal_speed_px_per_ms=_joined([lines.normal_speed_px_per_ms for lines in fitted], (0,)),
        event_offsets=np.concatenate([[0], np.cumsum(_joined(sizes, (0,)))]),
        event_xy_px=_joined([lines.event_xy_px for lines in fitted], (0, 2)),
        event_dt_us=_joined([lines.event_dt_us for lines in fitted], (0,)),
    )


def _joined(parts: list[Array], empty_shape: tuple[int, ...]) -> Array:
    return np.concatenate(parts) if parts else np.empty(empty_shape)
