"""Operations that answer many requests: what is answered survives whoever answered it.

Answers are appended to a journal, one file for each attempt. An attempt begins with what the best
one before it wrote; the journal of the last one becomes the blob that the operation answers with.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, insert, select, update

from roel_service.store.blobs import BlobStore
from roel_service.store.database import Database
from roel_service.store.files import make_folder
from roel_service.store.operations import operation_memory, queued_operation
from roel_service.store.records import (
    OperationMethod,
    OperationRecord,
    TaskRecord,
    TaskState,
    row_from_record,
)
from roel_service.store.requests import RequestId, once
from roel_service.store.schema import OPERATION, TASK
from roel_service.store.tasks import insert_task

SUFFIX = ".items"


@dataclass(frozen=True, kw_only=True)
class AnsweredBatch:
    """What a child made of a manifest.

    Attributes:
        journal: all answers, durable.
        item_count, failed_count: requests, and those without an answer.
    """

    journal: Path
    item_count: int
    failed_count: int


class Batches:
    """Begins batches, and says where their journals are."""

    def __init__(self, database: Database, blobs: BlobStore, folder: Path) -> None:
        self._database = database
        self._blobs = blobs
        self._folder = folder
        make_folder(folder)

    def begin(
        self,
        method: OperationMethod,
        manifest_sha256: str,
        item_count: int,
        *,
        named: Sequence[str] = (),
        request_sha256: str = "",
        request: RequestId | None = None,
    ) -> OperationRecord:
        """The operation, and its task, whose inputs are the manifest and what that names.

        Args:
            item_count: requests of the manifest.
            named: digests of blobs that the requests name; those that are there stay.
            request: what the caller named the request; the same one has the same operation.

        Raises:
            NotFoundError: no such manifest.
        """

        def act(connection: Connection) -> OperationRecord:
            self._blobs.require(manifest_sha256)
            operation = queued_operation(method, request_sha256=request_sha256)
            connection.execute(insert(OPERATION), row_from_record(operation))
            there = [sha256 for sha256 in named if self._blobs.path(sha256).exists()]
            parameters = str(item_count).encode()
            insert_task(connection, operation.id, parameters, [manifest_sha256, *there])
            return operation

        with self._database.write() as connection:
            memory = operation_memory(connection)
            return once(connection, request, memory, lambda: act(connection))

    def put_manifest(self, data: bytes) -> str:
        """Store requests that came in a message; the digest that names them."""
        return self._blobs.put(data)

    def blob_path(self, sha256: str) -> Path:
        """Where an uploaded file is; raises `NotFoundError`."""
        self._blobs.require(sha256)
        return self._blobs.path(sha256)

    def journal(self, task: TaskRecord) -> Path:
        """Where an attempt leaves its answers; attempts may overlap when a lease was lost."""
        return self._folder / f"{task.id}-{task.fence}{SUFFIX}"

    def earlier_journals(self, task: TaskRecord) -> list[Path]:
        """Those of the attempts before this one."""
        own = self.journal(task)
        return [path for path in self._folder.glob(f"{task.id}-*{SUFFIX}") if path != own]

    def delete_ended(self) -> None:
        """Delete the journals of tasks that have ended."""
        at_work = TASK.c.state.in_([TaskState.READY.value, TaskState.LEASED.value])
        with self._database.read() as connection:
            unfinished = set(connection.scalars(select(TASK.c.id).where(at_work)))
        for path in self._folder.glob(f"*{SUFFIX}"):
            if path.stem.partition("-")[0] not in unfinished:
                path.unlink(missing_ok=True)


class BatchCompletion:
    """The answers are a blob when the operation SUCCEEDED."""

    def __init__(self, blobs: BlobStore) -> None:
        self._blobs = blobs

    def succeed(
        self, connection: Connection, operation: OperationRecord, outcome: AnsweredBatch
    ) -> bytes:
        """Keep the journal for as long as the operation is remembered."""
        sha256 = self._blobs.adopt(outcome.journal)
        keep_result(connection, operation, sha256)
        answer = {
            "sha256": sha256,
            "size_bytes": outcome.journal.stat().st_size,
            "item_count": outcome.item_count,
            "failed_count": outcome.failed_count,
        }
        return json.dumps(answer).encode()

    def preview(self, connection: Connection, operation: OperationRecord, partial: Any) -> None:
        """There is none."""

    def fail(self, connection: Connection, operation: OperationRecord) -> None:
        """Journals are deleted with the garbage."""


def keep_result(connection: Connection, operation: OperationRecord, sha256: str) -> None:
    """Let the operation's row name a blob."""
    row = update(OPERATION).where(OPERATION.c.id == operation.id)
    connection.execute(row.values(result_sha256=sha256))
