"""Operations: long-running methods, from their request to their end.

A new method takes four steps:

1. A member of `OperationMethod`, named like the method of the service.
2. A function that checks the request and inserts `queued_operation(...)` in the same transaction as
   whatever the method works on; see `builds.Builds.begin`.
3. A `Completion`, entered in `store.Store`: what the end of the operation does to those rows.
4. In `service/records.py`, the resource that the metadata name as the target, and the answer.

The scheduler needs to know none of this: it runs the task and calls `advance`, then one of
`succeed`, `fail` and `cancel`.
"""

from __future__ import annotations

import dataclasses
import uuid
from collections.abc import Mapping
from typing import Any, Protocol

from sqlalchemy import Connection, delete, select, update

from roel_service.errors import NotFoundError, StateError
from roel_service.progress import Progress
from roel_service.store.database import Database
from roel_service.store.records import (
    UNFINISHED,
    OperationMethod,
    OperationRecord,
    OperationState,
    now_us,
    operation_from_row,
    stored,
)
from roel_service.store.retention import DAY_US, OPERATION_RETENTION_DAYS
from roel_service.store.schema import OPERATION


class Completion(Protocol):
    """What the end of an operation does to the rows it works on, in the same transaction."""

    def succeed(self, connection: Connection, operation: OperationRecord, outcome: Any) -> bytes:
        """Make the outcome of the task durable; the operation's result, empty if rows tell it."""

    def fail(self, connection: Connection, operation: OperationRecord) -> None:
        """Undo or mark what was begun; failing and being cancelled are the same here."""


class Operations:
    """Repository of operations. Every method that changes something is durable on return."""

    def __init__(
        self, database: Database, completions: Mapping[OperationMethod, Completion]
    ) -> None:
        self._database = database
        self._completions = completions

    def advance(
        self, operation_id: str, progress: Progress, metadata: bytes = b""
    ) -> OperationRecord:
        """Record how far an operation is; `metadata` is what else its caller can read of it."""
        changes = {
            "state": OperationState.RUNNING,
            "stage": progress.stage,
            "done_count": progress.done_count,
            "total_count": progress.total_count,
            "fraction": progress.fraction,
            "metadata": metadata,
        }
        with self._database.write() as connection:
            record = get_operation(connection, operation_id)
            return record if record.state.is_final else _change(connection, record, changes)

    def succeed(self, operation_id: str, outcome: Any) -> OperationRecord:
        """The operation SUCCEEDED with the outcome of its task."""
        with self._database.write() as connection:
            record = get_operation(connection, operation_id)
            if record.state.is_final:
                return record
            result = self._completions[record.method].succeed(connection, record, outcome)
            changes = {"state": OperationState.SUCCEEDED, "fraction": 1.0, "result": result}
            return _end(connection, record, changes)

    def fail(self, operation_id: str, error: bytes) -> OperationRecord:
        """The operation FAILED; the caller encodes the error."""
        return self._give_up(operation_id, {"state": OperationState.FAILED, "error": error})

    def cancel(self, operation_id: str) -> OperationRecord:
        """The operation is CANCELLED."""
        return self._give_up(operation_id, {"state": OperationState.CANCELLED})

    def get(self, operation_id: str) -> OperationRecord:
        """One operation; raises `NotFoundError`."""
        with self._database.read() as connection:
            return get_operation(connection, operation_id)

    def page(self, after_id: str, limit: int) -> list[OperationRecord]:
        """Operations with an id above `after_id`, in the order of ids."""
        query = select(OPERATION).where(OPERATION.c.id > after_id)
        with self._database.read() as connection:
            rows = connection.execute(query.order_by(OPERATION.c.id).limit(limit)).mappings()
            return [operation_from_row(row) for row in rows]

    def unfinished(self) -> list[OperationRecord]:
        """Operations that are queued or running."""
        query = select(OPERATION).where(OPERATION.c.state.in_([item.value for item in UNFINISHED]))
        with self._database.read() as connection:
            return [operation_from_row(row) for row in connection.execute(query).mappings()]

    def delete(self, operation_id: str) -> None:
        """Forget an operation, not what it made; raises `StateError` OPERATION_RUNNING."""
        with self._database.write() as connection:
            record = get_operation(connection, operation_id)
            if not record.state.is_final:
                expected = "an operation that has ended"
                reason = "OPERATION_RUNNING"
                raise StateError(operation_id, expected, record.state.value, reason=reason)
            connection.execute(delete(OPERATION).where(OPERATION.c.id == operation_id))

    def delete_expired(self) -> None:
        """Forget operations that ended long ago."""
        expired = OPERATION.c.expire_time_us.between(1, now_us())
        with self._database.write() as connection:
            connection.execute(delete(OPERATION).where(expired))

    def _give_up(self, operation_id: str, changes: dict[str, Any]) -> OperationRecord:
        with self._database.write() as connection:
            record = get_operation(connection, operation_id)
            if record.state.is_final:
                return record
            self._completions[record.method].fail(connection, record)
            return _end(connection, record, changes)


def queued_operation(
    method: OperationMethod,
    *,
    request_sha256: str = "",
    map_id: str = "",
    version: int = 0,
    event_stream_id: str = "",
) -> OperationRecord:
    """An operation that waits for its turn; the caller inserts it."""
    return OperationRecord(
        id=uuid.uuid4().hex,
        method=method,
        request_sha256=request_sha256,
        map_id=map_id,
        version=version,
        event_stream_id=event_stream_id,
        state=OperationState.QUEUED,
        stage="",
        done_count=0,
        total_count=0,
        fraction=0.0,
        metadata=b"",
        result=b"",
        error=b"",
        update_seq=1,
        create_time_us=now_us(),
        end_time_us=0,
        expire_time_us=0,
    )


def get_operation(connection: Connection, operation_id: str) -> OperationRecord:
    """One operation; raises `NotFoundError`."""
    query = select(OPERATION).where(OPERATION.c.id == operation_id)
    row = connection.execute(query).mappings().one_or_none()
    if row is None:
        raise NotFoundError("operation", "an existing one", operation_id)
    return operation_from_row(row)


def _end(
    connection: Connection, record: OperationRecord, changes: dict[str, Any]
) -> OperationRecord:
    end_time_us = now_us()
    expire_time_us = end_time_us + OPERATION_RETENTION_DAYS * DAY_US
    times = {"end_time_us": end_time_us, "expire_time_us": expire_time_us}
    return _change(connection, record, {**changes, **times})


def _change(
    connection: Connection, record: OperationRecord, changes: dict[str, Any]
) -> OperationRecord:
    counted = {**changes, "update_seq": record.update_seq + 1}
    row = update(OPERATION).where(OPERATION.c.id == record.id)
    connection.execute(row.values(stored(counted)))
    return dataclasses.replace(record, **counted)
