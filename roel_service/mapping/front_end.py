"""The lines of every frame: event images, detection, space-time planes.

What the events of a line say is summed up here, frame by frame, so that they need not be kept.
"""

from __future__ import annotations

import copy
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from roel_service.arrays import Array, FloatArray
from roel_service.config.stages import Config
from roel_service.geometry.projection import undistortion_table
from roel_service.in_order import in_order
from roel_service.mapping.curve_pieces import FRAME_STEP, pieces_of_frame
from roel_service.mapping.detect import EDLines, LineDetector, detect_lines
from roel_service.mapping.evidence import (
    Evidence,
    evidence_of,
    supporting_counts,
    supporting_forms,
)
from roel_service.mapping.frames import (
    Frames,
    event_frame,
    frame_slices,
    frame_times,
    frames_at,
)
from roel_service.mapping.match_points import images_to_match
from roel_service.mapping.plane_fit import (
    NO_LINES,
    FittedLines,
    fit_space_time_planes,
    observations_of_frames,
)
from roel_service.mapping.representations import event_images
from roel_service.mapping.run import CountedEvents, MappingRun
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventStream
from roel_service.scene.lines import LineObservations
from roel_service.scene.trajectory import Trajectory


@dataclass(frozen=True, eq=False, kw_only=True)
class Detected:
    """The lines of all frames.

    Attributes:
        frames: N frames that were looked at.
        observations: M lines, without their events.
        evidence: what the costs need of them.
        pieces: short pieces of edges where no line is, for `curves`; none where that is off.
        images: by frame, those that point matches are to be found in.
    """

    frames: Frames
    observations: LineObservations
    evidence: Evidence
    pieces: LineObservations
    images: dict[int, tuple[Array, ...]]


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameLines:
    """The lines of one frame; `detect_s` and `plane_fit_s` are what it took to find them."""

    t_us: int
    fitted: FittedLines
    event_forms: FloatArray
    event_counts: Array
    pieces: FittedLines
    images: tuple[Array, ...]
    detect_s: float
    plane_fit_s: float


# Frames that were looked at before, by index and time.
KnownFrames = Mapping[tuple[int, int], FrameLines]
NO_KNOWN_FRAMES: KnownFrames = MappingProxyType({})

# A frame's index and time, and a stream that holds the events around it.
FrameSlice = tuple[int, tuple[int, EventStream]]


class FrameReader:
    """Finds the lines of single frames; they are independent of each other.

    Args:
        trajectory: covers the windows of the frames that are read.
    """

    def __init__(
        self, trajectory: Trajectory, camera: Camera, config: Config, detector: LineDetector
    ) -> None:
        self._trajectory = trajectory
        self._camera = camera
        self._config = config
        self._detector = detector
        self._drawing = None if config.curves.method == "none" else EDLines(config.detect)
        self._ideal_px = undistortion_table(camera)

    def covering(self, trajectory: Trajectory) -> FrameReader:
        """The same with more poses."""
        reader = copy.copy(self)
        reader._trajectory = trajectory
        return reader

    def read(self, item: FrameSlice) -> FrameLines:
        """Detection and plane fit of one frame."""
        index, (t_us, stream) = item
        config = self._config
        started = time.perf_counter()
        frame = event_frame(
            stream,
            t_us,
            self._ideal_px,
            self._trajectory,
            self._camera,
            config.frames,
            config.detect,
        )
        drawn = list(event_images(frame, config.detect))
        seeds = detect_lines(drawn, self._detector, config.detect)
        images = images_to_match(index, frame, config)
        detected = time.perf_counter()
        rng = np.random.default_rng(np.random.SeedSequence(config.runtime.seed, spawn_key=(index,)))
        fitted = fit_space_time_planes(seeds, frame, config.plane_fit, rng)
        pieces = NO_LINES
        if self._drawing is not None and index % FRAME_STEP == 0:
            pieces = pieces_of_frame(drawn, fitted, frame, self._drawing, config)
        # The events end here: memory grows with the lines, not with the recording.
        observations = observations_of_frames([fitted])
        forms = supporting_forms(
            observations,
            frames_at(np.array([t_us]), self._trajectory, self._camera),
            self._trajectory,
            config.frames,
            config.refine,
        )
        return FrameLines(
            t_us=t_us,
            fitted=fitted.without_events(),
            event_forms=forms,
            event_counts=supporting_counts(observations, config.refine),
            pieces=pieces,
            images=images,
            detect_s=detected - started,
            plane_fit_s=time.perf_counter() - detected,
        )


def lines_of_all_frames(
    events: CountedEvents,
    trajectory: Trajectory,
    camera: Camera,
    config: Config,
    detector: LineDetector,
    run: MappingRun,
    known: KnownFrames = NO_KNOWN_FRAMES,
) -> Detected:
    """Detection and plane fit of every frame; frames are independent and run in threads.

    Args:
        events: read once, front to back.
        trajectory, camera: poses and calibration.
        config: every stage's table.
        detector: finds lines in images.
        run: is told how far the work is, and how long each stage took.
        known: frames that need not be read again.
    """
    reader = FrameReader(trajectory, camera, config, detector)

    def lines_of_frame(item: FrameSlice) -> FrameLines:
        index, (t_us, _) = item
        return known.get((index, t_us)) or reader.read(item)

    times_us = frame_times(trajectory, events.time_range_us, config.frames)
    reach_us = config.frames.max_half_window_us
    slices = enumerate(frame_slices(events.chunks(), times_us, reach_us))
    cached_count = sum((index, t_us) in known for index, t_us in enumerate(times_us))
    began = time.perf_counter()
    done: list[FrameLines] = []
    for lines in in_order(lines_of_frame, slices, worker_count(config)):
        done.append(lines)
        run.step(len(done), len(times_us), cached_count)
    run.share_wall_clock(
        time.perf_counter() - began,
        {
            "detect": sum(lines.detect_s for lines in done),
            "plane_fit": sum(lines.plane_fit_s for lines in done),
        },
    )
    frames = frames_at(np.array([lines.t_us for lines in done], np.int64), trajectory, camera)
    observations = observations_of_frames([lines.fitted for lines in done])
    return Detected(
        frames=frames,
        observations=observations,
        evidence=evidence_of(
            observations,
            frames,
            np.concatenate([np.empty((0, 6, 6)), *(lines.event_forms for lines in done)]),
            np.concatenate([np.empty(0, np.int64), *(lines.event_counts for lines in done)]),
        ),
        pieces=observations_of_frames([lines.pieces for lines in done]),
        images={index: lines.images for index, lines in enumerate(done)},
    )


def worker_count(config: Config) -> int:
    """Threads of the front end."""
    return config.runtime.worker_count or os.cpu_count() or 1
