"""What AppendEvents fills and tells."""

from __future__ import annotations

import hashlib

from roel_service.errors import EventsError
from roel_service.scene.camera import Camera
from roel_service.service.settings import Settings
from roel_service.service.uploads import request_part
from roel_service.store.event_streams import Chunk, EventStreams
from roel_service.store.records import EventStreamRecord
from roel_service.v1 import events_pb2
from roel_service.wire.chunks import check_chunk


class EventSink:
    """A recording, with the licence to append to it (see `Sink`); one chunk costs 1."""

    def __init__(
        self, streams: EventStreams, record: EventStreamRecord, settings: Settings
    ) -> None:
        self.credit = settings.append_credit_chunks
        self._streams = streams
        self._record = record
        self._max_size_bytes = settings.event_stream_bytes
        self._covered_us: list[list[int]] = []
        self._covered_pose_count = 0

    def cost(self, request: events_pb2.AppendEventsRequest) -> int:
        return 1

    def check(self, request: events_pb2.AppendEventsRequest) -> Chunk:
        return _checked_chunk(request_part(request, "chunk"), self._record.camera)

    def size_bytes(self, item: Chunk) -> int:
        return item.length

    def commit(self, items: list[Chunk]) -> events_pb2.AppendStatus:
        self._record = self._streams.append_chunks(
            self._record.id, self._record.fence, items, self._max_size_bytes
        )
        return self.status()

    def status(self) -> events_pb2.AppendStatus:
        """What is durable; in a thread, like the rest."""
        record = self._record
        if record.pose_count != self._covered_pose_count:
            self._covered_us = self._streams.covered_us(record)
            self._covered_pose_count = record.pose_count
        duration_us = record.end_us - record.start_us
        return events_pb2.AppendStatus(
            committed_seq=record.chunk_count,
            credit_chunks=self.credit,
            quality=events_pb2.AppendQuality(
                event_rate_hz=record.event_count / duration_us * 1e6 if duration_us else 0.0,
                pose_coverage=_share(self._covered_us, record.start_us, record.end_us),
                longest_gap_us=record.longest_gap_us,
            ),
        )


def _checked_chunk(message: events_pb2.EventChunk, camera: Camera) -> Chunk:
    """A chunk that is sound by itself; the order of chunks is the store's to check."""
    # Every look at a field of bytes is a copy.
    data = message.data
    summary = check_chunk(data)
    if (summary.width, summary.height) != (camera.width, camera.height):
        expected = f"events of a {camera.width}x{camera.height} sensor, as the camera's"
        found = f"{summary.width}x{summary.height}"
        raise EventsError(f"chunk {message.seq}", expected, found, reason="SENSOR_MISMATCH")
    return Chunk(
        seq=message.seq,
        t0_us=summary.t0_us,
        t1_us=summary.t1_us,
        event_count=summary.event_count,
        longest_step_us=summary.longest_step_us,
        length=len(data),
        data=data,
        sha256=hashlib.sha256(data).hexdigest(),
    )


def _share(spans_us: list[list[int]], start_us: int, end_us: int) -> float:
    """Part of the time from start to end that lies in the spans; 0 if there is no such time."""
    inside_us = sum(
        max(0, min(last_us, end_us) - max(first_us, start_us)) for first_us, last_us in spans_us
    )
    return inside_us / (end_us - start_us) if end_us > start_us else 0.0
