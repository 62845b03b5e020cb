"""Operations that make a map version: the version begins and ends with its operation."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import Connection, insert, update

from roel_service.store.blobs import BlobStore
from roel_service.store.database import Database
from roel_service.store.event_streams import get_mappable
from roel_service.store.map_rows import get_map
from roel_service.store.operations import operation_memory, queued_operation
from roel_service.store.records import (
    MapVersionRecord,
    OperationMethod,
    OperationRecord,
    VersionState,
    row_from_record,
    stored,
)
from roel_service.store.requests import RequestId, once
from roel_service.store.schema import MAP, MAP_VERSION, OPERATION
from roel_service.store.tasks import insert_task


@dataclass(frozen=True, kw_only=True)
class BuiltVersion:
    """What a build gives its version.

    Attributes:
        rlm_bytes: the map file.
        bounds_m: lower corner, then upper corner, 6 numbers.
        report: as the command line prints it; empty for an import.
        provenance: what the map was made of.
        imported_file: what it was read from; empty for a build.
        trajectory: its poses, serialized, if they were refined; else empty.
    """

    rlm_bytes: bytes
    line_count: int
    bounds_m: list[float]
    report: dict[str, Any]
    provenance: dict[str, str] = field(default_factory=dict)
    imported_file: dict[str, Any] = field(default_factory=dict)
    trajectory: bytes = b""


@dataclass(frozen=True, kw_only=True)
class ImportedBlob:
    """A file of lines in the store."""

    sha256: str
    size_bytes: int


class Builds:
    """Begins the operations that make a map version."""

    def __init__(self, database: Database, blobs: BlobStore) -> None:
        self._database = database
        self._blobs = blobs

    def begin(
        self,
        map_id: str,
        stream_id: str,
        request_sha256: str = "",
        *,
        parameters: bytes = b"",
        request: RequestId | None = None,
        follow: bool = False,
    ) -> OperationRecord:
        """A new version, the operation that builds it, and its task with these parameters.

        Args:
            request_sha256: digest of what was asked for.
            request: what the caller named the request; the same one has the same operation.
            follow: the recording may be open; the build follows its upload.

        Raises:
            NotFoundError: no such map or recording.
            StateError: MAP_DELETED, STREAM_NOT_FINALIZED, or NO_POSES.
        """

        def act(connection: Connection) -> OperationRecord:
            version = _next_version(connection, map_id, stream_id, follow=follow)
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

        with self._database.write() as connection:
            memory = operation_memory(connection)
            return once(connection, request, memory, lambda: act(connection))

    def check(self, map_id: str, stream_id: str, *, follow: bool = False) -> int:
        """Number of the version that a build would begin now; raises as `begin`."""
        with self._database.read() as connection:
            return _next_version(connection, map_id, stream_id, follow=follow)

    def begin_import(
        self,
        map_id: str,
        file: ImportedBlob,
        request_sha256: str = "",
        request: RequestId | None = None,
    ) -> OperationRecord:
        """A new version, the operation that fills it from a stored file, and its task.

        Raises:
            NotFoundError: no such map or blob.
            StateError: MAP_DELETED.
        """

        def act(connection: Connection) -> OperationRecord:
            version = get_map(connection, map_id).version_count + 1
            self._blobs.require(file.sha256)
            operation = queued_operation(
                OperationMethod.IMPORT_MAP,
                request_sha256=request_sha256,
                map_id=map_id,
                version=version,
            )
            insert_version(connection, operation, dataclasses.asdict(file))
            insert_task(connection, operation.id, b"", [file.sha256])
            return operation

        with self._database.write() as connection:
            memory = operation_memory(connection)
            return once(connection, request, memory, lambda: act(connection))

    def put_import(self, data: bytes) -> ImportedBlob:
        """Store a file that came with a request."""
        return ImportedBlob(sha256=self._blobs.put(data), size_bytes=len(data))


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
            "provenance": built.provenance,
            "imported_file": built.imported_file,
            "trajectory_sha256": self._blobs.put(built.trajectory) if built.trajectory else "",
            "trajectory_bytes": len(built.trajectory),
        }
        _change_version(connection, operation, changes)


def insert_version(
    connection: Connection, operation: OperationRecord, imported_file: dict[str, Any] | None = None
) -> None:
    """An operation that makes a version, with that version, the newest of its map."""
    counted = update(MAP).where(MAP.c.id == operation.map_id)
    connection.execute(counted.values(version_count=operation.version))
    version = dataclasses.replace(_creating(operation), imported_file=imported_file or {})
    connection.execute(insert(MAP_VERSION), row_from_record(version))
    connection.execute(insert(OPERATION), row_from_record(operation))


def _next_version(connection: Connection, map_id: str, stream_id: str, *, follow: bool) -> int:
    """Number of the version that a build begins; raises as `Builds.begin`."""
    version = get_map(connection, map_id).version_count + 1
    get_mappable(connection, stream_id, may_be_open=follow)
    return version


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
