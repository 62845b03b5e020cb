"""Operations that refine the poses of a recording, and perhaps make a version of its lines."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, insert

from roel_service.store.batches import keep_result
from roel_service.store.blobs import BlobStore
from roel_service.store.builds import BuiltVersion, VersionCompletion, insert_version
from roel_service.store.database import Database
from roel_service.store.event_streams import get_mappable
from roel_service.store.map_rows import get_map
from roel_service.store.operations import operation_memory, queued_operation
from roel_service.store.records import (
    OperationMethod,
    OperationRecord,
    TaskRecord,
    row_from_record,
)
from roel_service.store.requests import RequestId, once
from roel_service.store.schema import OPERATION
from roel_service.store.tasks import insert_task


@dataclass(frozen=True, kw_only=True)
class RefinedPoses:
    """What a refinement gives its operation.

    Attributes:
        trajectory: the refined poses, serialized.
        report: how it went, as the command line prints it.
        version: of the lines, if one was asked for.
    """

    trajectory: bytes
    report: dict[str, Any]
    version: BuiltVersion | None


class Refinements:
    """Begins refinements."""

    def __init__(self, database: Database, blobs: BlobStore) -> None:
        self._database = database
        self._blobs = blobs

    def begin(
        self,
        stream_id: str,
        parameters: bytes,
        *,
        fixed_map_sha256: str = "",
        target_map_id: str = "",
        request_sha256: str = "",
        request: RequestId | None = None,
    ) -> OperationRecord:
        """The operation, its task with these parameters, and the version it makes, if it does.

        Args:
            fixed_map_sha256: map file that holds the poses; it stays for as long as that takes.
            target_map_id: map that gets a version; empty if none does.
            request: what the caller named the request; the same one has the same operation.

        Raises:
            NotFoundError: no such recording or map.
            StateError: STREAM_NOT_FINALIZED, NO_POSES, MAP_DELETED.
        """

        def act(connection: Connection) -> OperationRecord:
            get_mappable(connection, stream_id, may_be_open=False)
            operation = queued_operation(
                OperationMethod.REFINE_POSES,
                request_sha256=request_sha256,
                map_id=target_map_id,
                version=_next_version(connection, target_map_id),
                event_stream_id=stream_id,
            )
            if target_map_id:
                insert_version(connection, operation)
            else:
                connection.execute(insert(OPERATION), row_from_record(operation))
            inputs = [fixed_map_sha256] if fixed_map_sha256 else []
            insert_task(connection, operation.id, parameters, inputs)
            return operation

        with self._database.write() as connection:
            memory = operation_memory(connection)
            return once(connection, request, memory, lambda: act(connection))

    def fixed_map(self, task: TaskRecord) -> tuple[str, Path] | None:
        """Digest and place of the map file that holds the poses."""
        found: Sequence[tuple[str, Path]] = [
            (sha256, self._blobs.path(sha256)) for sha256 in task.inputs
        ]
        return found[0] if found else None


class RefinementCompletion:
    """The poses are a blob when the operation SUCCEEDED, and the version is ACTIVE."""

    def __init__(self, blobs: BlobStore, versions: VersionCompletion) -> None:
        self._blobs = blobs
        self._versions = versions

    def succeed(
        self, connection: Connection, operation: OperationRecord, outcome: RefinedPoses
    ) -> bytes:
        """Keep the poses for as long as the operation is remembered."""
        sha256 = self._blobs.put(outcome.trajectory)
        keep_result(connection, operation, sha256)
        if outcome.version is not None:
            self._versions.succeed(connection, operation, outcome.version)
        size_bytes = len(outcome.trajectory)
        answer = {**outcome.report, "sha256": sha256, "size_bytes": size_bytes}
        return json.dumps(answer).encode()

    def preview(self, connection: Connection, operation: OperationRecord, partial: Any) -> None:
        """There is none."""

    def fail(self, connection: Connection, operation: OperationRecord) -> None:
        """The version, if there is one, stays as FAILED."""
        self._versions.fail(connection, operation)


def _next_version(connection: Connection, map_id: str) -> int:
    return get_map(connection, map_id).version_count + 1 if map_id else 0
