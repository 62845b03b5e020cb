"""Operations: long-running methods, from their request to their end.

A new method takes four steps:

1. A member of `OperationMethod`, named like the method of the service.
2. A function that checks the request and inserts `queued_operation(...)` and its task in the same
   transaction as whatever the method works on; see `builds.Builds.begin`.
3. A `Completion`, entered in `store.Store`: what the end of the operation does to those rows.
4. A `Prepare`, entered in `service.server`: what a child is to do, as told by the rows.
5. In `service/records.py`, the resource that the metadata name as the target, and the answer.

The scheduler needs to know none of this: it takes the task and calls `advance`, then one of
`succeed`, `fail`, `requeue` and `cancel`. All but the last name the lease of the attempt, and are
refused with `ConflictError` LEASE_LOST when it is void.
"""

from __future__ import annotations

import dataclasses
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Protocol

from sqlalchemy import Connection, delete, exists, select, update

from roel_service.errors import NotFoundError, StateError
from roel_service.failpoints import failpoint
from roel_service.progress import Progress
from roel_service.store.database import Database
from roel_service.store.quotas import CALLER, check_operations
from roel_service.store.records import (
    UNFINISHED,
    Lease,
    OperationMethod,
    OperationRecord,
    OperationState,
    TaskState,
    now_us,
    operation_from_row,
    stored,
)
from roel_service.store.requests import Memory, RequestId, recall
from roel_service.store.retention import DAY_US, OPERATION_RETENTION_DAYS
from roel_service.store.schema import OPERATION, TASK
from roel_service.store.tasks import check_lease, end_task, end_tasks_of, requeue_task

_UNFINISHED = OPERATION.c.state.in_([item.value for item in UNFINISHED])


class Completion(Protocol):
    """What the end of an operation does to the rows it works on, in the same transaction."""

    def succeed(self, connection: Connection, operation: OperationRecord, outcome: Any) -> bytes:
        """Make the outcome of the task durable; the operation's result, empty if rows tell it."""

    def preview(self, connection: Connection, operation: OperationRecord, partial: Any) -> None:
        """Make a first result usable that the outcome will replace."""

    def fail(self, connection: Connection, operation: OperationRecord) -> None:
        """Undo or mark what was begun; failing and being cancelled are the same here."""


class Operations:
    """Repository of operations. Every method that changes something is durable on return."""

    def __init__(
        self, database: Database, completions: Mapping[OperationMethod, Completion]
    ) -> None:
        self._database = database
        self._completions = completions

    def advance(self, lease: Lease, progress: Progress, metadata: bytes = b"") -> OperationRecord:
        """Record how far an operation is; `metadata` is what else its caller can read of it."""
        changes = {
            "state": OperationState.RUNNING,
            "stage": progress.stage,
            "done_count": progress.done_count,
            "total_count": progress.total_count,
            "fraction": progress.fraction,
            "metadata": metadata,
        }
        with self._leased(lease) as (connection, record):
            return _change(connection, record, changes)

    def preview(self, lease: Lease, partial: Any) -> OperationRecord:
        """A first result can be used."""
        with self._leased(lease) as (connection, record):
            self._completions[record.method].preview(connection, record, partial)
            failpoint("task.previewed")
            return _change(connection, record, {})

    def requeue(
        self,
        lease: Lease,
        *,
        not_before_us: int,
        attempt_count: int,
        memory_doublings: int,
        failure_hash: str,
    ) -> OperationRecord:
        """The attempt came to nothing; the operation waits for the next one."""
        changes = {
            "not_before_us": not_before_us,
            "attempt_count": attempt_count,
            "memory_doublings": memory_doublings,
            "failure_hash": failure_hash,
        }
        with self._leased(lease) as (connection, record):
            requeue_task(connection, lease, changes)
            return _change(connection, record, {"state": OperationState.QUEUED, "stage": ""})

    def succeed(self, lease: Lease, outcome: Any) -> OperationRecord:
        """The operation SUCCEEDED with the outcome of its task."""
        with self._leased(lease) as (connection, record):
            result = self._completions[record.method].succeed(connection, record, outcome)
            end_task(connection, lease, TaskState.DONE)
            failpoint("task.ended")
            changes = {"state": OperationState.SUCCEEDED, "fraction": 1.0, "result": result}
            return _end(connection, record, changes)

    def fail(self, lease: Lease, error: bytes) -> OperationRecord:
        """The operation FAILED; the caller encodes the error."""
        with self._leased(lease) as (connection, record):
            return self._give_up(connection, record, OperationState.FAILED, error)

    def cancel(self, operation_id: str) -> OperationRecord:
        """The operation is CANCELLED; one that has ended stays as it is."""
        return self._end_unfinished(operation_id, OperationState.CANCELLED)

    def abandon(self, operation_id: str, error: bytes) -> OperationRecord:
        """An operation without a task FAILED; one that has ended stays as it is."""
        return self._end_unfinished(operation_id, OperationState.FAILED, error)

    def without_task(self) -> list[str]:
        """Ids of unfinished operations that nobody will ever end."""
        has_task = exists().where(TASK.c.operation_id == OPERATION.c.id)
        with self._database.read() as connection:
            return list(connection.scalars(select(OPERATION.c.id).where(_UNFINISHED, ~has_task)))

    def get(self, operation_id: str) -> OperationRecord:
        """One operation; raises `NotFoundError`."""
        with self._database.read() as connection:
            return get_operation(connection, operation_id)

    def begun(self, request: RequestId | None) -> OperationRecord | None:
        """The operation that an earlier call with this request id began; raises as `recall`."""
        with self._database.read() as connection:
            return recall(connection, request, operation_memory(connection))

    def page(self, after_id: str, limit: int) -> list[OperationRecord]:
        """Operations with an id above `after_id`, in the order of ids."""
        query = select(OPERATION).where(OPERATION.c.id > after_id)
        with self._database.read() as connection:
            rows = connection.execute(query.order_by(OPERATION.c.id).limit(limit)).mappings()
            return [operation_from_row(row) for row in rows]

    def unfinished(self) -> list[OperationRecord]:
        """Operations that are queued or running."""
        query = select(OPERATION).where(_UNFINISHED)
        with self._database.read() as connection:
            return [operation_from_row(row) for row in connection.execute(query).mappings()]

    def check_quota(self) -> None:
        """Raise `LimitError` QUOTA_CONCURRENT_BUILDS if the caller may not begin one more."""
        with self._database.read() as connection:
            check_operations(connection)

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

    @contextmanager
    def _leased(self, lease: Lease) -> Iterator[tuple[Connection, OperationRecord]]:
        """A transaction on the operation of a valid lease."""
        with self._database.write() as connection:
            check_lease(connection, lease)
            yield connection, get_operation(connection, lease.operation_id)

    def _end_unfinished(
        self, operation_id: str, state: OperationState, error: bytes = b""
    ) -> OperationRecord:
        with self._database.write() as connection:
            record = get_operation(connection, operation_id)
            if record.state.is_final:
                return record
            return self._give_up(connection, record, state, error)

    def _give_up(
        self, connection: Connection, record: OperationRecord, state: OperationState, error: bytes
    ) -> OperationRecord:
        self._completions[record.method].fail(connection, record)
        end_tasks_of(connection, record.id)
        return _end(connection, record, {"state": state, "error": error})


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
        owner=CALLER.get().name,
    )


def operation_memory(connection: Connection) -> Memory[OperationRecord]:
    """Remembers an operation by its id: whoever asks again sees how far it is."""
    return Memory(lambda record: record.id, lambda key: get_operation(connection, key))


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
