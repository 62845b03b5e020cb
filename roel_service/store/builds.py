"""Operations: each builds one map version, and both end together."""

from __future__ import annotations

import dataclasses
import uuid
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, delete, insert, select, update

from roel_service.errors import NotFoundError, StateError
from roel_service.progress import Progress
from roel_service.store.blobs import BlobStore
from roel_service.store.database import Database
from roel_service.store.event_streams import get_finalized
from roel_service.store.maps import get_map
from roel_service.store.records import (
    UNFINISHED,
    MapVersionRecord,
    OperationRecord,
    OperationState,
    VersionState,
    now_us,
    operation_from_row,
    row_from_record,
    stored,
)
from roel_service.store.schema import MAP, MAP_VERSION, OPERATION


@dataclass(frozen=True, kw_only=True)
class BuiltVersion:
    """What a build gives its version.

    Attributes:
        rlm_bytes: the map file.
        bounds_m: lower corner, then upper corner, 6 numbers.
        report: as the command line prints it.
    """

    rlm_bytes: bytes
    line_count: int
    bounds_m: list[float]
    report: dict[str, Any]


class Builds:
    """Repository of operations. Every method that changes something is durable on return."""

    def __init__(self, database: Database, blobs: BlobStore) -> None:
        self._database = database
        self._blobs = blobs

    def begin(self, map_id: str, stream_id: str) -> OperationRecord:
        """A new version and the operation that builds it.

        Raises:
            NotFoundError: no such map or recording.
            StateError: STREAM_NOT_FINALIZED, or NO_POSES.
        """
        with self._database.write() as connection:
            version_number = get_map(connection, map_id).version_count + 1
            if get_finalized(connection, stream_id).pose_count == 0:
                raise StateError(stream_id, "a recording with poses", "none", reason="NO_POSES")
            operation = _queued(map_id, version_number, stream_id)
            counted = update(MAP).where(MAP.c.id == map_id)
            connection.execute(counted.values(version_count=version_number))
            connection.execute(insert(MAP_VERSION), row_from_record(_creating(operation)))
            connection.execute(insert(OPERATION), row_from_record(operation))
        return operation

    def advance(self, operation_id: str, progress: Progress) -> OperationRecord:
        """Record how far a build is."""
        changes = {
            "state": OperationState.RUNNING,
            "stage": progress.stage,
            "done_count": progress.done_count,
            "total_count": progress.total_count,
            "fraction": progress.fraction,
        }
        with self._database.write() as connection:
            return _change(connection, operation_id, changes)

    def succeed(self, operation_id: str, built: BuiltVersion) -> OperationRecord:
        """The operation SUCCEEDED and its version is ACTIVE."""
        operation = {"state": OperationState.SUCCEEDED, "fraction": 1.0, "end_time_us": now_us()}
        with self._database.write() as connection:
            # The blob comes first: a crash leaves an unused blob, never a dangling version.
            version = {
                "state": VersionState.ACTIVE,
                "sha256": self._blobs.put(built.rlm_bytes),
                "size_bytes": len(built.rlm_bytes),
                "line_count": built.line_count,
                "bounds_m": built.bounds_m,
                "report": built.report,
            }
            return _change(connection, operation_id, operation, version)

    def fail(self, operation_id: str, error: bytes) -> OperationRecord:
        """The operation and its version FAILED; the caller encodes the error."""
        operation = {"state": OperationState.FAILED, "error": error, "end_time_us": now_us()}
        with self._database.write() as connection:
            return _change(connection, operation_id, operation, {"state": VersionState.FAILED})

    def cancel(self, operation_id: str) -> OperationRecord:
        """The operation is CANCELLED and its version FAILED."""
        operation = {"state": OperationState.CANCELLED, "end_time_us": now_us()}
        with self._database.write() as connection:
            return _change(connection, operation_id, operation, {"state": VersionState.FAILED})

    def get(self, operation_id: str) -> OperationRecord:
        """One operation; raises `NotFoundError`."""
        with self._database.read() as connection:
            return _get(connection, operation_id)

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
        """Forget an operation, not its version; raises `StateError` OPERATION_RUNNING."""
        with self._database.write() as connection:
            record = _get(connection, operation_id)
            if not record.state.is_final:
                expected = "an operation that has ended"
                reason = "OPERATION_RUNNING"
                raise StateError(operation_id, expected, record.state.value, reason=reason)
            connection.execute(delete(OPERATION).where(OPERATION.c.id == operation_id))


def _change(
    connection: Connection,
    operation_id: str,
    operation_changes: dict[str, Any],
    version_changes: dict[str, Any] | None = None,
) -> OperationRecord:
    """Change an operation and its version; one that is final stays as it is."""
    record = _get(connection, operation_id)
    if record.state.is_final:
        return record
    changes = {**operation_changes, "update_seq": record.update_seq + 1}
    operation = update(OPERATION).where(OPERATION.c.id == operation_id)
    connection.execute(operation.values(stored(changes)))
    if version_changes is not None:
        version = update(MAP_VERSION).where(MAP_VERSION.c.operation_id == operation_id)
        connection.execute(version.values(stored(version_changes)))
    return dataclasses.replace(record, **changes)


def _get(connection: Connection, operation_id: str) -> OperationRecord:
    query = select(OPERATION).where(OPERATION.c.id == operation_id)
    row = connection.execute(query).mappings().one_or_none()
    if row is None:
        raise NotFoundError("operation", "an existing one", operation_id)
    return operation_from_row(row)


def _queued(map_id: str, version: int, stream_id: str) -> OperationRecord:
    return OperationRecord(
        id=uuid.uuid4().hex,
        map_id=map_id,
        version=version,
        event_stream_id=stream_id,
        state=OperationState.QUEUED,
        stage="",
        done_count=0,
        total_count=0,
        fraction=0.0,
        error=b"",
        update_seq=1,
        create_time_us=now_us(),
        end_time_us=0,
    )


def _creating(operation: OperationRecord) -> MapVersionRecord:
    return MapVersionRecord(
        map_id=operation.map_id,
        version=operation.version,
        state=VersionState.CREATING,
        event_stream_id=operation.event_stream_id,
        operation_id=operation.id,
        sha256="",
        size_bytes=0,
        line_count=0,
        bounds_m=[],
        report={},
        create_time_us=operation.create_time_us,
    )
