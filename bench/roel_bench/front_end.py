"""Lines of single frames: found, timed, and compared with what a camera ought to see.

The protocol of the paper's tables on plane fitting and detection, see `heatmaps`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from roel_bench.creases import crease_segments, offsets_px
from roel_bench.heatmaps import PixelMatches, draw_lines, match_distance_px, match_pixels
from roel_bench.results import Figures
from roel_bench.scenes import MapTruth, Scene
from roel_bench.visible_edges import VisibleEdges
from roel_service.arrays import BoolArray, FloatArray
from roel_service.config.stages import Config
from roel_service.errors import NoAnswerError
from roel_service.geometry.projection import undistortion_table
from roel_service.geometry.se3 import SE3
from roel_service.geometry.segments import left_normal, point_segment_distance
from roel_service.mapping.detect import detect_lines, line_detector
from roel_service.mapping.frames import EventFrame, event_frame, frame_slices, frame_times
from roel_service.mapping.plane_fit import FittedLines, fit_space_time_planes
from roel_service.mapping.representations import event_images
from roel_service.progress import StepCallback
from roel_service.scene.events import EventSource
from roel_service.scene.trajectory import MAX_POSE_GAP_US, Trajectory

# Every so many frames are compared: neighbours tell the same.
FRAME_STRIDE = 6
# A second, stricter distance: about the width of a line in an event image.
STRICT_DISTANCE_PX = 2.0
# Speed of the picture, to tell slow frames from fast ones.
SPEED_INTERVAL_US = 5_000
# An event this close to a line is explained by it.
EXPLAINED_PX = 2.0
# Events of a frame that are asked whether a line explains them.
ASKED_EVENT_COUNT = 2_000


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameLines:
    """Lines of one frame and how long they took.

    Attributes:
        frame: the events that they were found in.
        lines: what was found.
        detect_s, plane_fit_s: processor time, which a busy machine does not change.
    """

    frame: EventFrame
    lines: FittedLines
    detect_s: float
    plane_fit_s: float


def still_trajectory(events: EventSource) -> Trajectory:
    """Poses of a camera that does not move, for a recording without poses."""
    first_us, last_us = events.time_range_us or (0, 1)
    t_us = np.unique(np.append(np.arange(first_us, last_us, MAX_POSE_GAP_US), last_us))
    still = SE3(
        rotation=np.broadcast_to(np.eye(3), (len(t_us), 3, 3)), translation=np.zeros((len(t_us), 3))
    )
    return Trajectory(t_us=t_us, T_world_camera=still)


def lines_of_frames(scene: Scene, config: Config, stride: int) -> Iterator[FrameLines]:
    """Detection and plane fit of every `stride`-th frame, one after the other.

    Raises:
        NoAnswerError: the recording is too short for a frame.
    """
    trajectory = scene.trajectory or still_trajectory(scene.events)
    times_us = frame_times(trajectory, scene.events.time_range_us, config.frames)[::stride]
    if not times_us:
        raise NoAnswerError(scene.name, "events for at least one frame", "none")
    ideal_px = undistortion_table(scene.camera)
    detector = line_detector(config.detect)
    slices = frame_slices(scene.events.chunks(), times_us, config.frames.max_half_window_us)
    for index, (t_us, stream) in enumerate(slices):
        began = time.thread_time()
        frame = event_frame(
            stream, t_us, ideal_px, trajectory, scene.camera, config.frames, config.detect
        )
        seeds = detect_lines(event_images(frame, config.detect), detector, config.detect)
        detected = time.thread_time()
        rng = np.random.default_rng(np.random.SeedSequence(config.runtime.seed, spawn_key=(index,)))
        fitted = fit_space_time_planes(seeds, frame, config.plane_fit, rng)
        yield FrameLines(
            frame=frame,
            lines=fitted,
            detect_s=detected - began,
            plane_fit_s=time.thread_time() - detected,
        )


class FrameTruth:
    """What the camera ought to see in each frame; kept, since every variant asks for the same."""

    def __init__(self, scene: Scene, truth: MapTruth, trajectory: Trajectory) -> None:
        self.visible = VisibleEdges(truth, scene.camera)
        self.creases = crease_segments(truth.mesh)
        self.K = scene.camera.matrix
        self._trajectory = trajectory
        self._edge_maps: dict[int, BoolArray] = {}
        self._speeds: dict[int, float] = {}

    def pose(self, t_us: int) -> SE3:
        return self._trajectory.interpolate(np.array([t_us]))[0]

    def edge_map(self, t_us: int) -> BoolArray:
        """(H, W) true edges, one pixel wide."""
        if t_us not in self._edge_maps:
            self._edge_maps[t_us] = self.visible.edge_map(self.pose(t_us))
        return self._edge_maps[t_us]

    def speed_px_per_ms(self, t_us: int) -> float:
        """How fast the picture moves."""
        if t_us not in self._speeds:
            after = self.pose(t_us + SPEED_INTERVAL_US)
            self._speeds[t_us] = self.visible.speed_px_per_ms(
                self.pose(t_us), after, SPEED_INTERVAL_US * 1e-3
            )
        return self._speeds[t_us]


class FrameScores:
    """Sums over the frames of one variant."""

    def __init__(self) -> None:
        self.frame_count = 0
        self.line_count = 0
        self.event_count = 0
        self.seconds = {"detect": 0.0, "plane_fit": 0.0}
        self._explained: list[float] = []
        self._matches: list[PixelMatches] = []
        self._strict: list[PixelMatches] = []
        self._speeds: list[float] = []
        self._offsets: list[FloatArray] = []
        self._along_motion: list[FloatArray] = []

    def add(self, found: FrameLines) -> None:
        """Count the lines of one frame."""
        self.frame_count += 1
        self.event_count += len(found.frame.events)
        self.line_count += len(found.lines.segments_px)
        self.seconds["detect"] += found.detect_s
        self.seconds["plane_fit"] += found.plane_fit_s
        self._explained.append(explained_share(found))

    def compare(self, found: FrameLines, truth: FrameTruth) -> None:
        """Hold the lines of one frame against the true edges."""
        t_us = found.frame.events.t_ref_us
        edges = truth.edge_map(t_us)
        drawn = draw_lines(found.lines.segments_px, edges.shape)
        self._matches.append(match_pixels(drawn, edges, match_distance_px(edges.shape)))
        self._strict.append(match_pixels(drawn, edges, STRICT_DISTANCE_PX))
        self._speeds.append(truth.speed_px_per_ms(t_us))
        offsets = offsets_px(
            found.lines.segments_px, truth.creases, truth.visible, truth.pose(t_us), truth.K
        )
        # The left normal points either way; along the motion, a lag has one sign.
        motion = np.sign(found.lines.normal_speed_px_per_ms)
        belongs = np.isfinite(offsets)
        self._offsets.append(np.abs(offsets[belongs]))
        self._along_motion.append((offsets * motion)[belongs & (motion != 0)])

    def figures(self) -> Figures:
        """Everything that was counted; None where nothing was compared."""
        count = max(1, self.frame_count)
        common: Figures = {
            "lines_per_frame": self.line_count / count,
            "explained_event_share": _mean(np.array(self._explained)),
            "ms_per_frame": 1e3 * sum(self.seconds.values()) / count,
        }
        if not self._matches:
            return common
        total, strict = _sum(self._matches), _sum(self._strict)
        speeds = np.array(self._speeds)
        fast = speeds > np.nanmedian(speeds) if np.isfinite(speeds).any() else speeds > 0
        offsets, along = np.concatenate(self._offsets), np.concatenate(self._along_motion)
        return common | {
            "precision": total.precision,
            "recall": total.recall,
            "f_score": total.f_score,
            "f_score_2px": strict.f_score,
            "f_score_slow": _sum(
                [m for m, f in zip(self._matches, fast, strict=True) if not f]
            ).f_score,
            "f_score_fast": _sum(
                [m for m, f in zip(self._matches, fast, strict=True) if f]
            ).f_score,
            "compared_line_count": len(offsets),
            "offset_median_px": float(np.median(offsets)) if len(offsets) else None,
            "bias_along_motion_px": float(np.median(along)) if len(along) else None,
        }


def run_front_end(
    scene: Scene, config: Config, truth: FrameTruth | None, step: StepCallback, stride: int
) -> FrameScores:
    """Find, time and compare the lines of every `stride`-th frame."""
    scores = FrameScores()
    for found in lines_of_frames(scene, config, stride):
        scores.add(found)
        if truth is not None:
            scores.compare(found, truth)
        step(scores.frame_count, 0)
    return scores


def explained_share(found: FrameLines) -> float:
    """Share of the events of the smallest window that lie on a line; NaN without events."""
    start, stop = found.frame.windows[0]
    stride = max(1, math.ceil((stop - start) / ASKED_EVENT_COUNT))
    events_px = found.frame.compensated_px[start:stop:stride].astype(np.float64)
    if len(events_px) == 0:
        return math.nan
    tau_ms = 1e-3 * (found.frame.events.t_us[start:stop:stride] - found.frame.events.t_ref_us)
    nearest = np.full(len(events_px), np.inf)
    lines = found.lines
    for segment, speed in zip(lines.segments_px, lines.normal_speed_px_per_ms, strict=True):
        shift = (speed * tau_ms)[:, None] * left_normal(segment)
        np.minimum(nearest, point_segment_distance(events_px - shift, segment), out=nearest)
    return float((nearest < EXPLAINED_PX).mean())


def _sum(matches: list[PixelMatches]) -> PixelMatches:
    return sum(matches, PixelMatches())


def _mean(values: FloatArray) -> float | None:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else None
