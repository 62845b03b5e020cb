"""Inputs of a build in a child; named by the front, opened in the child."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from roel_service.config.stages import Config
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventSource, EventStream
from roel_service.scene.trajectory import Trajectory
from roel_service.v1 import types_pb2
from roel_service.wire.chunks import decode_chunk
from roel_service.wire.nouns import trajectory_from_proto


@dataclass(frozen=True, kw_only=True)
class BuildParameters:
    """Inputs of a build in a child, by files that never change.

    Attributes:
        event_file: chunks of a finalized recording, one behind the other.
        time_range_us: first and last event.
        chunk_lengths: bytes of each chunk.
        pose_files: serialized `Trajectory` messages in the order of time.
    """

    event_file: Path
    time_range_us: tuple[int, int]
    chunk_lengths: Sequence[int]
    pose_files: Sequence[Path]
    camera: Camera
    config: Config

    def open(self) -> tuple[EventSource, Trajectory, Camera]:
        """The recording; its events are read when somebody asks for them."""
        parts = (types_pb2.Trajectory.FromString(path.read_bytes()) for path in self.pose_files)
        return SealedRecording(self), trajectory_from_proto(*parts), self.camera


class SealedRecording:
    """A finalized recording as a source of events; one chunk is in memory at a time."""

    def __init__(self, parameters: BuildParameters) -> None:
        self._parameters = parameters

    @property
    def width(self) -> int:
        return self._parameters.camera.width

    @property
    def height(self) -> int:
        return self._parameters.camera.height

    @property
    def time_range_us(self) -> tuple[int, int]:
        return self._parameters.time_range_us

    def chunks(self) -> Iterator[EventStream]:
        """Decoded chunks in the order of time."""
        previous_t1_us = None
        with self._parameters.event_file.open("rb") as file:
            for length in self._parameters.chunk_lengths:
                chunk = decode_chunk(file.read(length), previous_t1_us=previous_t1_us)
                previous_t1_us = int(chunk.t_us[-1])
                yield chunk
