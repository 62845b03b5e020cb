"""Lines are found while a recording is still arriving.

What is found at a time does not depend on what comes later, so that a job on the whole recording
takes it over and finds the same as if it had found everything itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

from roel_service.config.stages import Config
from roel_service.in_order import in_order
from roel_service.mapping.detect import line_detector
from roel_service.mapping.frames import extended, frame_times_so_far
from roel_service.mapping.front_end import (
    FrameLines,
    FrameReader,
    FrameSlice,
    KnownFrames,
    worker_count,
)
from roel_service.mapping.run import MappingRun
from roel_service.progress import ProgressCallback
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventStream
from roel_service.scene.trajectory import Trajectory


class Arriving(Protocol):
    """A recording that grows."""

    def chunks(self) -> Iterator[tuple[EventStream, Trajectory]]:
        """Chunks in the order of time, each with all poses so far, which reach past its end.

        Waits for the next one, and ends when the recording is complete.
        """
        ...


def lines_ahead(
    recording: Arriving, camera: Camera, config: Config, progress: ProgressCallback
) -> KnownFrames:
    """The lines of all frames that can be told while the recording arrives."""
    run = MappingRun(progress)
    known: dict[tuple[int, int], FrameLines] = {}
    slices = _slices(recording, camera, config)
    for key, lines in in_order(_read, slices, worker_count(config)):
        known[key] = lines
        run.step(len(known), 0)
    return known


def _read(item: tuple[FrameReader, FrameSlice]) -> tuple[tuple[int, int], FrameLines]:
    reader, frame = item
    index, (t_us, _) = frame
    return (index, t_us), reader.read(frame)


def _slices(
    recording: Arriving, camera: Camera, config: Config
) -> Iterator[tuple[FrameReader, FrameSlice]]:
    """Every frame as soon as its events and poses are there."""
    reach_us = config.frames.max_half_window_us
    reader: FrameReader | None = None
    buffer: EventStream | None = None
    first_us, index = 0, 0
    for chunk, trajectory in recording.chunks():
        if buffer is None:
            first_us = end_us = int(chunk.t_us[0])
        # A frame whose window ended before `end_us` has been read.
        buffer = extended(buffer, chunk, keep_from_us=end_us - 2 * reach_us)
        end_us = int(chunk.t_us[-1])
        if reader is None:
            reader = FrameReader(trajectory, camera, config, line_detector(config.detect))
        reader = reader.covering(trajectory)
        times_us = frame_times_so_far(trajectory, (first_us, end_us), config.frames)
        for t_us in times_us[index:]:
            yield reader, (index, (t_us, buffer))
            index += 1
