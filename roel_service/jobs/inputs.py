"""Inputs of a build in a child; named by the front, opened in the child."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from roel_service.config.stages import Config
from roel_service.errors import StateError
from roel_service.jobs.cache_place import CachePlace
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventSource, EventStream
from roel_service.scene.trajectory import Trajectory
from roel_service.store.event_streams import EventStreams
from roel_service.store.records import EventStreamRecord
from roel_service.v1 import types_pb2
from roel_service.wire.chunks import decode_chunk
from roel_service.wire.nouns import trajectory_from_proto


@dataclass(frozen=True, kw_only=True)
class BuildParameters:
    """Inputs of a build in a child, by files that never change.

    Attributes:
        event_file: chunks of a finalized recording, one behind the other; named by its digest.
        time_range_us: first and last event.
        chunk_lengths: bytes of each chunk.
        pose_files: serialized `Trajectory` messages in the order of time; named by their digests.
        cache: for the results of stages; None keeps nothing.
    """

    event_file: Path
    time_range_us: tuple[int, int]
    chunk_lengths: Sequence[int]
    pose_files: Sequence[Path]
    camera: Camera
    config: Config
    cache: CachePlace | None = None

    def open(self) -> tuple[EventSource, Trajectory, Camera]:
        """The recording; its events are read when somebody asks for them."""
        return SealedRecording(self), read_poses(self.pose_files), self.camera

    @property
    def recording_digest(self) -> str:
        """Of everything that is read."""
        names = [self.event_file.name, *(path.name for path in self.pose_files)]
        return hashlib.sha256("\n".join([*names, repr(self.camera)]).encode()).hexdigest()


@dataclass(frozen=True, kw_only=True)
class FollowParameters:
    """Inputs of a build that begins while its recording is still open.

    Attributes:
        folder: the data folder, in which the recording grows.
        patience_s: an upload that stands still for longer is given up.
        cache: as of `BuildParameters`.
    """

    folder: Path
    stream_id: str
    config: Config
    patience_s: float
    cache: CachePlace | None = None


def sealed_parameters(
    streams: EventStreams, stream: EventStreamRecord, config: Config, cache: CachePlace | None
) -> BuildParameters:
    """Inputs of a build from a finalized recording; raises `StateError` NO_POSES."""
    if stream.pose_count == 0:
        raise StateError(stream.id, "a recording with poses", "none", reason="NO_POSES")
    return BuildParameters(
        event_file=streams.event_file(stream),
        time_range_us=(stream.start_us, stream.end_us),
        chunk_lengths=streams.chunk_lengths(stream),
        pose_files=streams.pose_files(stream),
        camera=stream.camera,
        config=config,
        cache=cache,
    )


def read_poses(paths: Sequence[Path]) -> Trajectory:
    """All poses of a recording."""
    parts = (types_pb2.Trajectory.FromString(path.read_bytes()) for path in paths)
    return trajectory_from_proto(*parts)


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
