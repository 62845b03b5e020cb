"""Operations that fill an empty recording from a stored file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, insert

from roel_service.store.blobs import BlobStore
from roel_service.store.database import Database
from roel_service.store.event_streams import (
    ChunkFacts,
    EventStreams,
    adopt_chunks,
    begin_filling,
)
from roel_service.store.operations import operation_memory, queued_operation
from roel_service.store.recordings import Recordings
from roel_service.store.records import OperationMethod, OperationRecord, row_from_record
from roel_service.store.requests import RequestId, once
from roel_service.store.schema import OPERATION
from roel_service.store.tasks import insert_task


@dataclass(frozen=True, kw_only=True)
class ImportedEvents:
    """What a child made of a file.

    Attributes:
        fence: licence to fill the recording, as `begin` gave it.
        file: the chunks one behind the other, durable; taken by the recording.
    """

    fence: int
    file: Path
    chunks: Sequence[ChunkFacts]


class EventImports:
    """Begins imports."""

    def __init__(self, database: Database, blobs: BlobStore, streams: EventStreams) -> None:
        self._database = database
        self._blobs = blobs
        self._streams = streams

    def begin(
        self,
        stream_id: str,
        sha256: str,
        request_sha256: str = "",
        request: RequestId | None = None,
    ) -> OperationRecord:
        """The operation that fills a recording from a blob, and its task.

        Its parameters are the fence of the recording: whoever wrote it before is replaced, and
        whoever takes it over makes the import fail.

        Raises:
            NotFoundError: no such recording or blob.
            StateError: STREAM_FINALIZED, STREAM_NOT_EMPTY.
        """

        def act(connection: Connection) -> OperationRecord:
            self._blobs.require(sha256)
            record = begin_filling(connection, stream_id)
            operation = queued_operation(
                OperationMethod.IMPORT_EVENT_STREAM,
                request_sha256=request_sha256,
                event_stream_id=stream_id,
            )
            connection.execute(insert(OPERATION), row_from_record(operation))
            insert_task(connection, operation.id, str(record.fence).encode(), [sha256])
            return operation

        with self._streams.locks.holding(stream_id), self._database.write() as connection:
            memory = operation_memory(connection)
            return once(connection, request, memory, lambda: act(connection))

    def blob_path(self, sha256: str) -> Path:
        """The file to import."""
        return self._blobs.path(sha256)


class EventImportCompletion:
    """The recording has all events when its operation SUCCEEDED, and none however else it ended."""

    def __init__(self, recordings: Recordings) -> None:
        self._recordings = recordings

    def succeed(
        self, connection: Connection, operation: OperationRecord, outcome: ImportedEvents
    ) -> bytes:
        """Give the recording its file and its rows; the recording is the answer.

        Raises:
            ConflictError: WRITER_REPLACED.
            StateError: STREAM_FINALIZED, STREAM_NOT_EMPTY.
        """
        stream_id = operation.event_stream_id
        record = adopt_chunks(connection, stream_id, outcome.fence, outcome.chunks)
        # Before the transaction ends: a crash leaves bytes that no row counts, which are cut away.
        self._recordings.replace(record.uid, outcome.file)
        return b""

    def preview(self, connection: Connection, operation: OperationRecord, partial: Any) -> None:
        """There is none."""

    def fail(self, connection: Connection, operation: OperationRecord) -> None:
        """Nothing was begun."""
