"""A build that begins before its recording is complete: it reads what has become durable."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

from roel_service.errors import StateError
from roel_service.jobs.inputs import (
    BuildParameters,
    FollowParameters,
    read_poses,
    sealed_parameters,
)
from roel_service.mapping.ahead import lines_ahead
from roel_service.mapping.front_end import KnownFrames
from roel_service.progress import ProgressCallback
from roel_service.scene.events import EventStream
from roel_service.scene.trajectory import Trajectory
from roel_service.store.event_streams import EventStreams
from roel_service.store.records import EventStreamRecord, StreamState
from roel_service.store.store import recordings_of
from roel_service.wire.chunks import decode_chunk

# Rows are looked at this often: short against the time that a chunk takes to arrive.
POLL_INTERVAL_S = 0.05


def follow(
    parameters: FollowParameters, progress: ProgressCallback
) -> tuple[KnownFrames, BuildParameters]:
    """Look for lines until the recording is finalized; they, and the inputs of the build.

    Raises:
        StateError: STREAM_NOT_FINALIZED, the upload stands still; NO_POSES.
    """
    with recordings_of(parameters.folder) as streams:
        recording = OpenRecording(streams, parameters.stream_id, parameters.patience_s)
        camera = streams.get(parameters.stream_id).camera
        known = lines_ahead(recording, camera, parameters.config, progress)
        stream = streams.get(parameters.stream_id)
        return known, sealed_parameters(streams, stream, parameters.config, parameters.cache)


class OpenRecording:
    """Chunks of a recording as they become durable, once there are poses for all their events.

    Args:
        streams: where the recording's rows and files are.
        patience_s: raise when nothing has come for so long.
    """

    def __init__(self, streams: EventStreams, stream_id: str, patience_s: float) -> None:
        self._streams = streams
        self._stream_id = stream_id
        self._patience_s = patience_s
        self._pose_count = 0
        self._trajectory: Trajectory | None = None

    def chunks(self) -> Iterator[tuple[EventStream, Trajectory]]:
        """Until the recording is finalized; what is left then needs no hurry."""
        seq, offset, end_us = 0, 0, None
        for record in self._looks():
            trajectory = self._poses(record)
            for length in self._streams.chunk_lengths(record)[seq:]:
                data = _read(self._streams.append_file(record), offset, length)
                if data is None or trajectory is None:
                    break
                chunk = decode_chunk(data, previous_t1_us=end_us)
                if trajectory.t_us[-1] < chunk.t_us[-1]:
                    break
                yield chunk, trajectory
                seq, offset, end_us = seq + 1, offset + length, int(chunk.t_us[-1])

    def _looks(self) -> Iterator[EventStreamRecord]:
        """The record after each change, while the recording is open."""
        last, changed_s = None, time.monotonic()
        while (record := self._streams.get(self._stream_id)).state is StreamState.OPEN:
            now_s = time.monotonic()
            if record != last:
                last, changed_s = record, now_s
                yield record
            elif now_s - changed_s > self._patience_s:
                expected = "an upload that goes on"
                found = f"none for {self._patience_s:.0f} s"
                reason = "STREAM_NOT_FINALIZED"
                raise StateError(self._stream_id, expected, found, reason=reason)
            else:
                time.sleep(POLL_INTERVAL_S)

    def _poses(self, record: EventStreamRecord) -> Trajectory | None:
        if record.pose_count > max(1, self._pose_count):
            self._trajectory = read_poses(self._streams.pose_files(record))
            self._pose_count = record.pose_count
        return self._trajectory


def _read(path: Path, offset: int, length: int) -> bytes | None:
    """Committed bytes of an append file; None when it has just been sealed."""
    try:
        with path.open("rb") as file:
            file.seek(offset)
            return file.read(length)
    except FileNotFoundError:
        return None
