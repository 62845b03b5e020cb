"""EventStreamService: recordings arrive."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from functools import partial
from itertools import islice
from typing import Any

from google.longrunning import operations_pb2
from google.protobuf.empty_pb2 import Empty

from roel_service.errors import InputError, LimitError, TrajectoryError
from roel_service.jobs.scheduler import Scheduler
from roel_service.service.append import EventSink
from roel_service.service.labels import checked_labels
from roel_service.service.operations import submitted
from roel_service.service.paging import page_of, page_request
from roel_service.service.records import event_stream_to_proto
from roel_service.service.requests import content_sha256, request_id
from roel_service.service.settings import Settings
from roel_service.service.uploads import OpenUploads, Upload, next_request, request_part
from roel_service.store.event_streams import PosePart
from roel_service.store.records import EventStreamRecord
from roel_service.store.store import Store
from roel_service.v1 import events_pb2, types_pb2
from roel_service.wire import names
from roel_service.wire.chunks import decode_chunk
from roel_service.wire.nouns import (
    camera_from_proto,
    trajectory_columns,
    trajectory_from_proto,
    trajectory_to_proto,
)
from roel_service.wire.preview import EventPicture

# Chunks may be small; reading them is what takes the time then.
MAX_PREVIEW_CHUNK_COUNT = 256


class EventStreamServicer:
    """Decodes requests, calls the store in a thread, encodes answers."""

    def __init__(
        self, store: Store, scheduler: Scheduler, uploads: OpenUploads, settings: Settings
    ) -> None:
        self._store = store
        self._scheduler = scheduler
        self._streams = store.event_streams
        self._uploads = uploads
        self._settings = settings
        self._drawing = asyncio.Lock()

    async def CreateEventStream(
        self, request: events_pb2.CreateEventStreamRequest, context: Any
    ) -> events_pb2.EventStream:
        names.check_parent(request.parent)
        stream_id = names.checked_id(request.event_stream_id, "event_stream_id")
        camera = camera_from_proto(request.event_stream.camera)
        labels = checked_labels(request.event_stream.labels, self._settings)
        create = self._streams.create
        record = await asyncio.to_thread(create, stream_id, camera, request_id(request), labels)
        return event_stream_to_proto(record)

    async def AppendEvents(
        self, requests: AsyncIterator[events_pb2.AppendEventsRequest], context: Any
    ) -> AsyncIterator[events_pb2.AppendStatus]:
        stream_id = await self._stream_id(requests)
        record = await asyncio.to_thread(self._streams.take_over, stream_id)
        sink = EventSink(self._streams, record, self._settings)
        upload = Upload(requests, sink, self._settings)
        with self._uploads.entered(f"recording {stream_id}", record.fence, upload):
            yield await asyncio.to_thread(sink.status)
            async for status in upload.statuses():
                yield status

    async def QueryAppendStatus(
        self, request: events_pb2.QueryAppendStatusRequest, context: Any
    ) -> events_pb2.AppendStatus:
        record = await self._record(request.name)
        sink = EventSink(self._streams, record, self._settings)
        return await asyncio.to_thread(sink.status)

    async def AppendPoses(
        self, requests: AsyncIterator[events_pb2.AppendPosesRequest], context: Any
    ) -> events_pb2.EventStream:
        stream_id = await self._stream_id(requests)
        parts: list[types_pb2.Trajectory] = []
        pose_count = 0
        while (request := await next_request(requests, self._settings)) is not None:
            parts.append(request_part(request, "poses"))
            pose_count += _checked_count(parts[-1])
            if pose_count > self._settings.pose_count:
                expected = f"at most {self._settings.pose_count}"
                raise LimitError("poses", expected, f"{pose_count}", reason="TOO_MANY_POSES")
        record = await asyncio.to_thread(self._append_poses, stream_id, parts)
        return event_stream_to_proto(record)

    async def ReadEvents(
        self, request: events_pb2.ReadEventsRequest, context: Any
    ) -> AsyncIterator[events_pb2.EventChunk]:
        record = await self._record(request.name)
        start_us = request.start_us if request.HasField("start_us") else record.start_us
        stop_us = request.stop_us if request.HasField("stop_us") else record.end_us + 1
        with self._streams.reading(record) as reader:
            chunks = reader.chunks(start_us, stop_us)
            while (chunk := await asyncio.to_thread(next, chunks, None)) is not None:
                yield events_pb2.EventChunk(seq=chunk.seq, data=chunk.data)

    async def PreviewEvents(
        self, request: events_pb2.PreviewEventsRequest, context: Any
    ) -> events_pb2.PreviewEventsResponse:
        record = await self._record(request.name)
        # One at a time: the front has other things to do.
        async with self._drawing:
            return await asyncio.to_thread(self._preview, record, request.start_us, request.stop_us)

    async def ImportEventStream(
        self, request: events_pb2.ImportEventStreamRequest, context: Any
    ) -> operations_pb2.Operation:
        identity = request_id(request)
        begin = partial(
            self._store.event_imports.begin,
            names.event_stream_id(request.name),
            names.checked_sha256(request.blob.sha256),
            content_sha256(request),
            identity,
        )
        return await submitted(self._store, self._scheduler, begin, identity)

    async def FinalizeEventStream(
        self, request: events_pb2.FinalizeEventStreamRequest, context: Any
    ) -> events_pb2.EventStream:
        stream_id = names.event_stream_id(request.name)
        finalize = self._streams.finalize
        record = await asyncio.to_thread(finalize, stream_id, request.etag, request_id(request))
        return event_stream_to_proto(record)

    async def GetEventStream(
        self, request: events_pb2.GetEventStreamRequest, context: Any
    ) -> events_pb2.EventStream:
        return event_stream_to_proto(await self._record(request.name))

    async def ListEventStreams(
        self, request: events_pb2.ListEventStreamsRequest, context: Any
    ) -> events_pb2.ListEventStreamsResponse:
        names.check_parent(request.parent)
        wanted = page_request("eventStreams", request.page_size, request.page_token)
        page = await asyncio.to_thread(page_of, wanted, self._streams.page, lambda item: item.id)
        return events_pb2.ListEventStreamsResponse(
            event_streams=[event_stream_to_proto(item) for item in page.items],
            next_page_token=page.next_page_token,
        )

    async def DeleteEventStream(
        self, request: events_pb2.DeleteEventStreamRequest, context: Any
    ) -> Empty:
        stream_id = names.event_stream_id(request.name)
        delete = self._streams.delete
        await asyncio.to_thread(delete, stream_id, request.etag, request_id(request))
        return Empty()

    async def _record(self, name: str) -> EventStreamRecord:
        return await asyncio.to_thread(self._streams.get, names.event_stream_id(name))

    def _preview(
        self, record: EventStreamRecord, start_us: int, stop_us: int
    ) -> events_pb2.PreviewEventsResponse:
        picture = EventPicture(record.camera.width, record.camera.height)
        left_count = self._settings.preview_event_count
        with self._streams.reading(record) as reader:
            for chunk in islice(reader.chunks(start_us, stop_us), MAX_PREVIEW_CHUNK_COUNT):
                events = decode_chunk(chunk.data, previous_t1_us=None).between(start_us, stop_us)
                drawn = events.first(left_count)
                picture.add(drawn)
                left_count -= len(drawn)
                if left_count == 0:
                    break
        return events_pb2.PreviewEventsResponse(
            png=picture.png(), event_count=self._settings.preview_event_count - left_count
        )

    async def _stream_id(self, requests: AsyncIterator[Any]) -> str:
        """The recording that the first message of an upload names."""
        request = await next_request(requests, self._settings)
        if request is None:
            raise InputError("upload", "a message that names the recording", "none")
        return names.event_stream_id(request_part(request, "event_stream"))

    def _append_poses(self, stream_id: str, parts: list[types_pb2.Trajectory]) -> EventStreamRecord:
        trajectory = trajectory_from_proto(*parts)
        part = PosePart(
            t0_us=int(trajectory.t_us[0]),
            t1_us=int(trajectory.t_us[-1]),
            pose_count=len(trajectory),
            covered_us=trajectory.covered_us().tolist(),
            data=trajectory_to_proto(trajectory).SerializeToString(deterministic=True),
        )
        return self._streams.append_poses(stream_id, part, self._settings.pose_count)


def _checked_count(poses: types_pb2.Trajectory) -> int:
    """How many poses a message holds; every message holds some, so that their number is bounded."""
    t_us, _, _ = trajectory_columns(poses)
    if len(t_us) == 0:
        raise TrajectoryError("poses", "at least one in every message", "none")
    return len(t_us)
