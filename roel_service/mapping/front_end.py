"""The lines of every frame: event images, detection, space-time planes.

What the events of a line say is summed up here, frame by frame, so that they need not be kept.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass

import numpy as np

from roel_service.arrays import Array, FloatArray
from roel_service.config.stages import Config
from roel_service.geometry.projection import undistortion_table
from roel_service.in_order import in_order
from roel_service.mapping.detect import LineDetector, detect_lines
from roel_service.mapping.evidence import Evidence, evidence_of, supporting_forms
from roel_service.mapping.frames import (
    Frames,
    event_frame,
    frame_slices,
    frame_times,
    frames_at,
)
from roel_service.mapping.match_points import images_to_match
from roel_service.mapping.plane_fit import (
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
        images: by frame, those that point matches are to be found in.
    """

    frames: Frames
    observations: LineObservations
    evidence: Evidence
    images: dict[int, tuple[Array, ...]]


@dataclass(frozen=True, eq=False, kw_only=True)
class _FrameLines:
    t_us: int
    fitted: FittedLines
    event_forms: FloatArray
    event_counts: Array
    images: tuple[Array, ...]
    detect_s: float
    plane_fit_s: float


def lines_of_all_frames(
    events: CountedEvents,
    trajectory: Trajectory,
    camera: Camera,
    config: Config,
    detector: LineDetector,
    run: MappingRun,
) -> Detected:
    """Detection and plane fit of every frame; frames are independent and run in threads.

    Args:
        events: read once, front to back.
        trajectory, camera: poses and calibration.
        config: every stage's table.
        detector: finds lines in images.
        run: is told how far the work is, and how long each stage took.
    """
    ideal_px = undistortion_table(camera)

    def lines_of_frame(item: tuple[int, tuple[int, EventStream]]) -> _FrameLines:
        index, (t_us, stream) = item
        started = time.perf_counter()
        frame = event_frame(
            stream, t_us, ideal_px, trajectory, camera, config.frames, config.detect
        )
        seeds = detect_lines(event_images(frame, config.detect), detector, config.detect)
        images = images_to_match(index, frame, config)
        detected = time.perf_counter()
        rng = np.random.default_rng(np.random.SeedSequence(config.runtime.seed, spawn_key=(index,)))
        fitted = fit_space_time_planes(seeds, frame, config.plane_fit, rng)
        # The events end here: memory grows with the lines, not with the recording.
        forms = supporting_forms(
            observations_of_frames([fitted]),
            frames_at(np.array([t_us]), trajectory, camera),
            trajectory,
            config.frames,
            config.refine,
        )
        return _FrameLines(
            t_us=t_us,
            fitted=fitted.without_events(),
            event_forms=forms,
            event_counts=np.diff(fitted.event_offsets),
            images=images,
            detect_s=detected - started,
            plane_fit_s=time.perf_counter() - detected,
        )

    times_us = frame_times(trajectory, events.time_range_us, config.frames)
    reach_us = config.frames.max_half_window_us
    slices = enumerate(frame_slices(events.chunks(), times_us, reach_us))
    began = time.perf_counter()
    worker_count = config.runtime.worker_count or os.cpu_count() or 1
    done: list[_FrameLines] = []
    for lines in in_order(lines_of_frame, slices, worker_count):
        done.append(lines)
        run.step(len(done), len(times_us))
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
        images={index: lines.images for index, lines in enumerate(done)},
    )
