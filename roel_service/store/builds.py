"""Operations that make a map version: the version begins and ends with its operation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, insert, update

from roel_service.errors import StateError
from roel_service.store.blobs import BlobStore
from roel_service.store.database import Database
from roel_service.store.event_streams import get_finalized
from roel_service.store.map_rows import get_map
from roel_service.store.operations import queued_operation
from roel_service.store.records import (
    MapVersionRecord,
    OperationMethod,
    OperationRecord,
    VersionState,
    row_from_record,
    stored,
)
from roel_service.store.schema import MAP, MAP_VERSION, OPERATION
from roel_service.store.tasks import insert_task


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
    """Begins the operations that make a map version."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def begin(
        self, map_id: str, stream_id: str, request_sha256: str = "", *, parameters: bytes = b""
    ) -> OperationRecord:
        """A new version, the operation that builds it, and its task with these parameters.

        Raises:
            NotFoundError: no such map or recording.
            StateError: STREAM_NOT_FINALIZED, or NO_POSES.
        """
        with self._database.write() as connection:
            version = get_map(connection, map_id).version_count + 1
            if get_finalized(connection, stream_id).pose_count == 0:
                raise StateError(stream_id, "a recording with poses", "none", reason="NO_POSES")
            operation = queued_operation(
                OperationMethod.BUILD_MAP,
                request_sha256=request_sha256,
                map_id=map_id,
                version=version,
                event_stream_id=stream_id,
            )
            insert_version(connection, operation)
            insert_task(connection, operation.id, parameters, [])
        return operation


class VersionCompletion:
    """The version is ACTIVE when its operation SUCCEEDED, and FAILED however else it ended."""

    def __init__(self, blobs: BlobStore) -> None:
        self._blobs = blobs

    def succeed(
        self, connection: Connection, operation: OperationRecord, outcome: BuiltVersion
    ) -> bytes:
        """Store the map file, then the row that names it; the version is the answer."""
        self._fill(connection, operation, outcome, VersionState.ACTIVE)
        return b""

    def preview(
        self, connection: Connection, operation: OperationRecord, partial: BuiltVersion
    ) -> None:
        """The version can be used, as a PREVIEW."""
        self._fill(connection, operation, partial, VersionState.PREVIEW)

    def fail(self, connection: Connection, operation: OperationRecord) -> None:
        """The version stays, as FAILED."""
        _change_version(connection, operation, {"state": VersionState.FAILED})

    def _fill(
        self,
        connection: Connection,
        operation: OperationRecord,
        built: BuiltVersion,
        state: VersionState,
    ) -> None:
        # The blob comes first: a crash leaves an unused blob, never a dangling version.
        changes = {
            "state": state,
            "sha256": self._blobs.put(built.rlm_bytes),
            "size_bytes": len(built.rlm_bytes),
            "line_count": built.line_count,
            "bounds_m": built.bounds_m,
            "report": built.report,
        }
        _change_version(connection, operation, changes)


def insert_version(connection: Connection, operation: OperationRecord) -> None:
    """An operation that makes a version, with that version, the newest of its map."""
    counted = update(MAP).where(MAP.c.id == operation.map_id)
    connection.execute(counted.values(version_count=operation.version))
    connection.execute(insert(MAP_VERSION), row_from_record(_creating(operation)))
    connection.execute(insert(OPERATION), row_from_record(operation))


def _change_version(
    connection: Connection, operation: OperationRecord, changes: dict[str, Any]
) -> None:
    row = update(MAP_VERSION).where(MAP_VERSION.c.operation_id == operation.id)
    connection.execute(row.values(stored(changes)))


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
