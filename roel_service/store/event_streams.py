"""Recordings: rows, append files and, once finalized, blobs."""

from __future__ import annotations

import dataclasses
import itertools
import json
import uuid
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from sqlalchemy import (
    Connection,
    RowMapping,
    bindparam,
    delete,
    exists,
    insert,
    select,
    update,
)

from roel_service.errors import (
    ConflictError,
    EventsError,
    LimitError,
    NotFoundError,
    StateError,
    TrajectoryError,
)
from roel_service.failpoints import failpoint
from roel_service.scene.camera import Camera
from roel_service.scene.trajectory import MAX_POSE_GAP_US
from roel_service.store.blobs import BlobStore
from roel_service.store.chunk_reader import ChunkReader
from roel_service.store.database import Database
from roel_service.store.etags import check_etag
from roel_service.store.locks import KeyedLocks
from roel_service.store.quotas import CALLER, check_event_streams, check_stored_bytes
from roel_service.store.recordings import Recordings
from roel_service.store.records import (
    UNFINISHED,
    EventStreamRecord,
    StreamState,
    event_stream_from_row,
    now_us,
    row_from_record,
    stored,
)
from roel_service.store.requests import RequestId, once, recall, row_memory
from roel_service.store.schema import EVENT_CHUNK, EVENT_STREAM, OPERATION, POSE_PART

_MEMORY = row_memory(event_stream_from_row)

# What appending does fifty times a second; made once, because that takes longer than executing it.
_SELECT_STREAM = select(EVENT_STREAM).where(EVENT_STREAM.c.id == bindparam("stream_id"))
_INSERT_CHUNKS = insert(EVENT_CHUNK)
_GROWING = ("chunk_count", "event_count", "size_bytes", "start_us", "end_us", "longest_gap_us")
_GROW = (
    update(EVENT_STREAM)
    .where(EVENT_STREAM.c.uid == bindparam("of_uid"))
    .values({name: bindparam(name) for name in _GROWING})
    .returning(EVENT_STREAM.c.pose_count)
)


@dataclass(frozen=True, kw_only=True)
class ChunkFacts:
    """What a row tells of a chunk, which was checked once and found sound.

    Attributes:
        longest_step_us: longest time between two neighbouring events of the chunk.
        length: its bytes.
        sha256: of its bytes, hexadecimal.
    """

    seq: int
    t0_us: int
    t1_us: int
    event_count: int
    longest_step_us: int
    length: int
    sha256: str


@dataclass(frozen=True, kw_only=True)
class Chunk(ChunkFacts):
    """A chunk with its bytes."""

    data: bytes


@dataclass(frozen=True, kw_only=True)
class PosePart:
    """Poses as they are stored; `data` has been decoded once and found sound.

    Attributes:
        covered_us: first and last times between which poses are dense enough, in order.
    """

    t0_us: int
    t1_us: int
    pose_count: int
    covered_us: list[list[int]]
    data: bytes


class EventStreams:
    """Repository of recordings. Every method that changes something is durable on return."""

    def __init__(self, database: Database, blobs: BlobStore, recordings: Recordings) -> None:
        self._database = database
        self._blobs = blobs
        self._recordings = recordings
        # Whoever changes the chunks of a recording holds its lock, so that the slow part, making a
        # file durable, needs no transaction.
        self.locks = KeyedLocks()

    def create(
        self,
        stream_id: str,
        camera: Camera,
        request: RequestId | None = None,
        labels: dict[str, str] | None = None,
    ) -> EventStreamRecord:
        """Open a recording.

        Raises:
            ConflictError: ALREADY_EXISTS.
            LimitError: QUOTA_EVENT_STREAMS.
        """
        record = EventStreamRecord(
            id=stream_id,
            uid=uuid.uuid4().hex,
            state=StreamState.OPEN,
            camera=camera,
            chunk_count=0,
            event_count=0,
            size_bytes=0,
            start_us=0,
            end_us=0,
            pose_count=0,
            digest="",
            fence=0,
            longest_gap_us=0,
            create_time_us=now_us(),
            owner=CALLER.get().name,
            labels=labels or {},
        )

        def act(connection: Connection) -> EventStreamRecord:
            if _row(connection, stream_id) is not None:
                expected = "an id not in use"
                raise ConflictError("event stream", expected, stream_id, reason="ALREADY_EXISTS")
            check_event_streams(connection)
            connection.execute(insert(EVENT_STREAM), row_from_record(record))
            self._recordings.create(record.uid)
            return record

        with self._database.write() as connection:
            return once(connection, request, _MEMORY, partial(act, connection))

    def get(self, stream_id: str) -> EventStreamRecord:
        """One recording; raises `NotFoundError`."""
        with self._database.read() as connection:
            return _get(connection, stream_id)

    def page(self, after_id: str, limit: int) -> list[EventStreamRecord]:
        """Recordings with an id above `after_id`, in the order of ids."""
        query = select(EVENT_STREAM).where(EVENT_STREAM.c.id > after_id)
        with self._database.read() as connection:
            rows = connection.execute(query.order_by(EVENT_STREAM.c.id).limit(limit)).mappings()
            return [event_stream_from_row(row) for row in rows]

    def take_over(self, stream_id: str) -> EventStreamRecord:
        """Become the one writer of a recording; whoever was it before can append no more.

        Returns:
            The recording; its fence is the writer's licence to append.

        Raises:
            StateError: STREAM_FINALIZED.
        """
        with self.locks.holding(stream_id), self._database.write() as connection:
            record = _get_open(connection, stream_id)
            return _update(connection, record, fence=record.fence + 1)

    def append_chunks(
        self, stream_id: str, fence: int, chunks: Sequence[Chunk], max_size_bytes: int
    ) -> EventStreamRecord:
        """Append chunks, all or none; those already stored are compared and left out.

        Args:
            fence: of the record that `take_over` gave.

        Raises:
            StateError: STREAM_FINALIZED, or SEQUENCE_GAP with the number that is expected.
            ConflictError: WRITER_REPLACED; CHUNK_CONFLICT, a stored chunk comes again with other
                bytes.
            EventsError: a chunk that begins before the end of the one before it.
            LimitError: EVENT_STREAM_TOO_LARGE, QUOTA_STORAGE.
        """
        with self.locks.holding(stream_id):
            with self._database.read() as connection:
                record = _get_writable(connection, stream_id, fence)
                fresh = [chunk for chunk in chunks if not _is_repeat(connection, record, chunk)]
                check_stored_bytes(connection, sum(chunk.length for chunk in fresh))
            if not fresh:
                return record
            _check_order(record, fresh)
            rows = _chunk_rows(record, fresh)
            _check_size(rows[-1], max_size_bytes)
            self._recordings.append(record.uid, record.size_bytes, (chunk.data for chunk in fresh))
            with self._database.write() as connection:
                connection.execute(_INSERT_CHUNKS, rows)
                grown = _grown(record, fresh)
                # Poses may have come meanwhile; the chunks are still those of `record`.
                pose_count = connection.execute(_GROW, {"of_uid": record.uid, **grown}).scalar_one()
            return dataclasses.replace(record, pose_count=pose_count, **grown)

    def append_poses(
        self, stream_id: str, part: PosePart, max_pose_count: int
    ) -> EventStreamRecord:
        """Append poses that begin after all stored ones.

        Raises:
            StateError: STREAM_FINALIZED.
            TrajectoryError: the part does not begin after the stored poses.
            LimitError: TOO_MANY_POSES.
        """
        with self._database.write() as connection:
            record = _get_open(connection, stream_id)
            parts = _pose_rows(connection, record.uid)
            if parts and part.t0_us <= parts[-1]["t1_us"]:
                expected = f"poses after {parts[-1]['t1_us']} us"
                raise TrajectoryError("poses", expected, f"{part.t0_us} us")
            pose_count = record.pose_count + part.pose_count
            if pose_count > max_pose_count:
                expected = f"at most {max_pose_count}"
                raise LimitError("poses", expected, f"{pose_count}", reason="TOO_MANY_POSES")
            row = {
                "stream_uid": record.uid,
                "seq": len(parts),
                "pose_count": part.pose_count,
                "t0_us": part.t0_us,
                "t1_us": part.t1_us,
                "covered_us": part.covered_us,
                "sha256": self._blobs.put(part.data),
            }
            connection.execute(insert(POSE_PART), stored(row))
            return _update(connection, record, pose_count=pose_count)

    def finalize(
        self, stream_id: str, etag: str = "", request: RequestId | None = None
    ) -> EventStreamRecord:
        """Freeze a recording and seal its events into a blob.

        Raises:
            EventsError: NO_EVENTS.
            ConflictError: ETAG_MISMATCH.
        """
        with self.locks.holding(stream_id):
            with self._database.read() as connection:
                known = recall(connection, request, _MEMORY)
                record = known or _get(connection, stream_id)
            if known is not None or record.state is StreamState.FINALIZED:
                return record
            check_etag(record.etag, etag)
            if record.event_count == 0:
                raise EventsError(stream_id, "events", "none", reason="NO_EVENTS")
            digest = self._blobs.adopt(self._recordings.cut(record.uid, record.size_bytes))
            failpoint("recording.sealed")

            def act(connection: Connection) -> EventStreamRecord:
                current = _get(connection, stream_id)
                return _update(connection, current, state=StreamState.FINALIZED, digest=digest)

            with self._database.write() as connection:
                sealed = once(connection, request, _MEMORY, partial(act, connection))
            self._recordings.delete(record.uid)
            return sealed

    def delete(self, stream_id: str, etag: str = "", request: RequestId | None = None) -> None:
        """Forget a recording; its blobs are left to the sweep.

        Raises:
            StateError: STREAM_IN_USE, a build reads it.
            ConflictError: ETAG_MISMATCH.
        """

        def act(connection: Connection) -> EventStreamRecord:
            record = _get(connection, stream_id)
            check_etag(record.etag, etag)
            if _is_in_use(connection, stream_id):
                raise StateError(stream_id, "no build", "one at work", reason="STREAM_IN_USE")
            connection.execute(delete(EVENT_STREAM).where(EVENT_STREAM.c.uid == record.uid))
            return record

        with self.locks.holding(stream_id), self._database.write() as connection:
            deleted = once(connection, request, _MEMORY, partial(act, connection))
        self._recordings.delete(deleted.uid)

    def event_file(self, record: EventStreamRecord) -> Path:
        """The sealed chunks of a finalized recording."""
        return self._blobs.path(record.digest)

    def append_file(self, record: EventStreamRecord) -> Path:
        """The chunks of an open recording; what lies behind its `size_bytes` is not committed."""
        return self._recordings.path(record.uid)

    def chunk_lengths(self, record: EventStreamRecord) -> list[int]:
        """Bytes of every chunk, in order."""
        of_stream = EVENT_CHUNK.c.stream_uid == record.uid
        query = select(EVENT_CHUNK.c.length).where(of_stream).order_by(EVENT_CHUNK.c.seq)
        with self._database.read() as connection:
            return list(connection.scalars(query))

    def pose_files(self, record: EventStreamRecord) -> list[Path]:
        """The pose parts of a recording, in the order of time."""
        with self._database.read() as connection:
            return [self._blobs.path(row["sha256"]) for row in _pose_rows(connection, record.uid)]

    @contextmanager
    def reading(self, record: EventStreamRecord) -> Iterator[ChunkReader]:
        """The durable chunks of a recording, for as long as the block lasts.

        Raises:
            NotFoundError: it was deleted meanwhile.
        """
        path = self._recordings.path(record.uid)
        if record.state is StreamState.FINALIZED:
            path = self._blobs.path(record.digest)
        try:
            file = path.open("rb")
        except FileNotFoundError:
            # It was frozen between the two looks, or is gone.
            file = self._blobs.path(self.get(record.id).digest).open("rb")
        with file:
            yield ChunkReader(self._database, record.uid, file)

    def covered_us(self, record: EventStreamRecord) -> list[list[int]]:
        """First and last times between which poses are dense enough, in order."""
        with self._database.read() as connection:
            return _joined(_covered_us(row) for row in _pose_rows(connection, record.uid))

    def recover(self) -> None:
        """Cut append files to what was committed, and delete those of no open recording."""
        query = select(EVENT_STREAM.c.uid, EVENT_STREAM.c.size_bytes).where(
            EVENT_STREAM.c.state == StreamState.OPEN.value
        )
        with self._database.read() as connection:
            committed_bytes = {row.uid: row.size_bytes for row in connection.execute(query)}
        self._recordings.sweep(committed_bytes)


def begin_filling(connection: Connection, stream_id: str) -> EventStreamRecord:
    """Become the one writer of a recording without events.

    Raises:
        StateError: STREAM_FINALIZED, STREAM_NOT_EMPTY.
    """
    record = _get_empty(connection, stream_id)
    return _update(connection, record, fence=record.fence + 1)


def adopt_chunks(
    connection: Connection, stream_id: str, fence: int, chunks: Sequence[ChunkFacts]
) -> EventStreamRecord:
    """All chunks of a recording at once; the caller puts the file in place.

    Raises:
        StateError: STREAM_FINALIZED, STREAM_NOT_EMPTY.
        ConflictError: WRITER_REPLACED.
    """
    record = _get_empty(connection, stream_id)
    if record.fence != fence:
        raise writer_replaced(stream_id)
    _check_order(record, chunks)
    connection.execute(insert(EVENT_CHUNK), _chunk_rows(record, chunks))
    return _update(connection, record, **_grown(record, chunks))


def get_finalized(connection: Connection, stream_id: str) -> EventStreamRecord:
    """A recording that can be mapped; raises `StateError` STREAM_NOT_FINALIZED."""
    record = _get(connection, stream_id)
    if record.state is not StreamState.FINALIZED:
        reason = "STREAM_NOT_FINALIZED"
        raise StateError(stream_id, "a finalized recording", record.state.value, reason=reason)
    return record


def get_mappable(connection: Connection, stream_id: str, *, may_be_open: bool) -> EventStreamRecord:
    """A recording for a build; raises `StateError` STREAM_NOT_FINALIZED, or NO_POSES."""
    record = _get(connection, stream_id)
    if record.state is StreamState.OPEN and may_be_open:
        return record
    if get_finalized(connection, stream_id).pose_count == 0:
        raise StateError(stream_id, "a recording with poses", "none", reason="NO_POSES")
    return record


def _row(connection: Connection, stream_id: str) -> RowMapping | None:
    return connection.execute(_SELECT_STREAM, {"stream_id": stream_id}).mappings().one_or_none()


def _get(connection: Connection, stream_id: str) -> EventStreamRecord:
    row = _row(connection, stream_id)
    if row is None:
        raise NotFoundError("event stream", "an existing one", stream_id)
    return event_stream_from_row(row)


def _get_open(connection: Connection, stream_id: str) -> EventStreamRecord:
    record = _get(connection, stream_id)
    if record.state is not StreamState.OPEN:
        reason = "STREAM_FINALIZED"
        raise StateError(stream_id, "an open recording", record.state.value, reason=reason)
    return record


def _get_empty(connection: Connection, stream_id: str) -> EventStreamRecord:
    record = _get_open(connection, stream_id)
    if record.chunk_count:
        found = f"{record.chunk_count} chunks"
        reason = "STREAM_NOT_EMPTY"
        raise StateError(stream_id, "a recording without events", found, reason=reason)
    return record


def _get_writable(connection: Connection, stream_id: str, fence: int) -> EventStreamRecord:
    record = _get_open(connection, stream_id)
    if record.fence != fence:
        raise writer_replaced(stream_id)
    return record


def writer_replaced(subject: str) -> ConflictError:
    """The error for a writer whose recording or upload another one took over."""
    return ConflictError(subject, "one writer", "another that took over", reason="WRITER_REPLACED")


def _update(connection: Connection, record: EventStreamRecord, **values: Any) -> EventStreamRecord:
    row = update(EVENT_STREAM).where(EVENT_STREAM.c.uid == record.uid)
    connection.execute(row.values(stored(values)))
    return dataclasses.replace(record, **values)


def _is_repeat(connection: Connection, record: EventStreamRecord, chunk: Chunk) -> bool:
    if chunk.seq >= record.chunk_count:
        return False
    query = select(EVENT_CHUNK.c.sha256).where(
        EVENT_CHUNK.c.stream_uid == record.uid, EVENT_CHUNK.c.seq == chunk.seq
    )
    if connection.execute(query).scalar_one() != chunk.sha256:
        expected = "the bytes that were stored"
        reason = "CHUNK_CONFLICT"
        raise ConflictError(f"chunk {chunk.seq}", expected, "other bytes", reason=reason)
    return True


def _check_order(record: EventStreamRecord, chunks: Sequence[ChunkFacts]) -> None:
    end_us = record.end_us if record.chunk_count else chunks[0].t0_us
    for seq, chunk in enumerate(chunks, start=record.chunk_count):
        if chunk.seq != seq:
            raise StateError("seq", f"{seq}", f"{chunk.seq}", reason="SEQUENCE_GAP")
        if chunk.t0_us < end_us:
            expected = f"events from {end_us} us on"
            reason = "EVENT_TIME_NOT_MONOTONE"
            raise EventsError(f"chunk {seq}", expected, f"{chunk.t0_us} us", reason=reason)
        end_us = chunk.t1_us


def _chunk_rows(record: EventStreamRecord, chunks: Sequence[ChunkFacts]) -> list[dict[str, Any]]:
    rows = []
    offset = record.size_bytes
    for chunk in chunks:
        row = {
            "stream_uid": record.uid,
            "seq": chunk.seq,
            "t0_us": chunk.t0_us,
            "t1_us": chunk.t1_us,
            "event_count": chunk.event_count,
            "offset": offset,
            "length": chunk.length,
            "sha256": chunk.sha256,
        }
        rows.append(row)
        offset += chunk.length
    return rows


def _check_size(last_row: dict[str, Any], max_size_bytes: int) -> None:
    size_bytes = last_row["offset"] + last_row["length"]
    if size_bytes > max_size_bytes:
        expected = f"at most {max_size_bytes} bytes of events"
        reason = "EVENT_STREAM_TOO_LARGE"
        raise LimitError("event stream", expected, f"{size_bytes}", reason=reason)


def _grown(record: EventStreamRecord, chunks: Sequence[ChunkFacts]) -> dict[str, Any]:
    """What changes in a record when chunks are appended."""
    ends_us = [record.end_us if record.chunk_count else chunks[0].t0_us]
    ends_us += [chunk.t1_us for chunk in chunks]
    pauses_us = [chunk.t0_us - end_us for chunk, end_us in zip(chunks, ends_us, strict=False)]
    steps_us = [chunk.longest_step_us for chunk in chunks]
    return {
        "chunk_count": record.chunk_count + len(chunks),
        "event_count": record.event_count + sum(chunk.event_count for chunk in chunks),
        "size_bytes": record.size_bytes + sum(chunk.length for chunk in chunks),
        "start_us": record.start_us if record.chunk_count else chunks[0].t0_us,
        "end_us": chunks[-1].t1_us,
        "longest_gap_us": max(record.longest_gap_us, *steps_us, *pauses_us),
    }


def _covered_us(row: RowMapping) -> list[list[int]]:
    """Of one pose part; parts of older releases do not tell, and count as dense."""
    return json.loads(row["covered_us"]) or [[row["t0_us"], row["t1_us"]]]


def _joined(parts: Iterable[list[list[int]]]) -> list[list[int]]:
    """Spans of all parts; neighbours that no gap divides become one."""
    joined: list[list[int]] = []
    for first_us, last_us in itertools.chain.from_iterable(parts):
        if joined and first_us - joined[-1][1] <= MAX_POSE_GAP_US:
            joined[-1][1] = last_us
        else:
            joined.append([first_us, last_us])
    return joined


def _pose_rows(connection: Connection, uid: str) -> Sequence[RowMapping]:
    query = select(POSE_PART).where(POSE_PART.c.stream_uid == uid).order_by(POSE_PART.c.seq)
    return connection.execute(query).mappings().all()


def _is_in_use(connection: Connection, stream_id: str) -> bool:
    unfinished = OPERATION.c.state.in_([state.value for state in UNFINISHED])
    query = select(exists().where(OPERATION.c.event_stream_id == stream_id, unfinished))
    return bool(connection.execute(query).scalar_one())
