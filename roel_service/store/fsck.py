"""Is a data folder what it should be? Every digest is recomputed, every invariant checked."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, RowMapping, exists, func, select

from roel_service.errors import InputError
from roel_service.store.blobs import BlobStore
from roel_service.store.database import Database
from roel_service.store.recordings import Recordings
from roel_service.store.records import (
    UNFINISHED,
    OperationState,
    StreamState,
    TaskState,
    VersionState,
)
from roel_service.store.references import referenced
from roel_service.store.schema import (
    EVENT_CHUNK,
    EVENT_STREAM,
    MAP,
    MAP_ALIAS,
    MAP_VERSION,
    OPERATION,
    POSE_PART,
    TASK,
    UPLOAD,
)

# A server at work may move a file between two looks; what is wrong is so each time.
LOOK_COUNT = 3


@dataclass(frozen=True, kw_only=True)
class Findings:
    """What a check found.

    Attributes:
        problems: one line each; empty for a sound folder.
    """

    problems: list[str]
    blob_count: int
    blob_bytes: int
    event_stream_count: int
    map_version_count: int
    operation_count: int
    seconds: float


def check_folder(folder: Path) -> Findings:
    """Check a data folder, also one that a server has open; nothing is changed.

    Raises:
        InputError: no data folder.
        StateError: DATA_TOO_NEW, or DATA_TOO_OLD before its first start with this release.
    """
    if not (folder / "rows.sqlite").is_file():
        raise InputError(str(folder), "a data folder", "none")
    began_s = time.perf_counter()
    check = _Check(folder)
    try:
        check.database.check_version()
        for _ in range(LOOK_COUNT):
            problems = list(check.problems())
            if not problems:
                break
        return check.findings(problems, time.perf_counter() - began_s)
    finally:
        check.database.close()


class _Check:
    """One look at a folder."""

    def __init__(self, folder: Path) -> None:
        self.database = Database(folder / "rows.sqlite")
        self._blobs = BlobStore(folder / "blobs" / "sha256")
        self._recordings = Recordings(folder / "recordings")
        self._uploads = folder / "uploads"

    def problems(self) -> Iterator[str]:
        """All that is wrong."""
        checks: tuple[Callable[[Connection], Iterator[str]], ...] = (
            _database_problems,
            self._blob_problems,
            self._stream_problems,
            self._upload_problems,
            _version_problems,
            _alias_problems,
            _operation_problems,
        )
        with self.database.snapshot() as connection:
            for check in checks:
                yield from check(connection)

    def findings(self, problems: list[str], seconds: float) -> Findings:
        """The problems, and how much was looked at."""
        stored = list(self._blobs.stored())
        with self.database.snapshot() as connection:
            streams, versions, operations = (
                int(connection.scalar(select(func.count()).select_from(table)) or 0)
                for table in (EVENT_STREAM, MAP_VERSION, OPERATION)
            )
        return Findings(
            problems=problems,
            blob_count=len(stored),
            blob_bytes=sum(blob.size_bytes for blob in stored),
            event_stream_count=streams,
            map_version_count=versions,
            operation_count=operations,
            seconds=seconds,
        )

    def _blob_problems(self, connection: Connection) -> Iterator[str]:
        named = referenced(connection)
        stored = {blob.sha256 for blob in self._blobs.stored()}
        for sha256 in sorted(named - stored):
            yield f"blob {sha256}: named by a row, but missing"
        for sha256 in sorted(stored):
            found = self._blobs.found_digest(sha256)
            if found not in (sha256, None):
                yield f"blob {sha256}: its bytes have the digest {found}"

    def _stream_problems(self, connection: Connection) -> Iterator[str]:
        for stream in connection.execute(select(EVENT_STREAM)).mappings().all():
            yield from self._chunk_problems(stream, _chunks(connection, stream["uid"]))
            poses = select(func.coalesce(func.sum(POSE_PART.c.pose_count), 0))
            found = connection.scalar(poses.where(POSE_PART.c.stream_uid == stream["uid"]))
            yield from _unequal(f"recording {stream['id']}", "pose_count", stream, found)

    def _upload_problems(self, connection: Connection) -> Iterator[str]:
        for upload in connection.execute(select(UPLOAD)):
            path = self._uploads / f"{upload.id}.upload"
            found = path.stat().st_size if path.exists() else 0
            if found < upload.committed_bytes:
                yield f"upload {upload.id}: {found} of {upload.committed_bytes} acknowledged bytes"

    def _chunk_problems(self, stream: RowMapping, chunks: list[RowMapping]) -> Iterator[str]:
        name = f"recording {stream['id']}"
        sums = {
            "chunk_count": len(chunks),
            "event_count": sum(chunk["event_count"] for chunk in chunks),
            "size_bytes": sum(chunk["length"] for chunk in chunks),
        }
        for column, found in sums.items():
            yield from _unequal(name, column, stream, found)
        is_open = stream["state"] == StreamState.OPEN.value
        path = self._recordings.path(stream["uid"])
        if not is_open:
            path = self._blobs.path(stream["digest"])
        if not path.exists():
            yield f"{name}: its events are missing"
            return
        with path.open("rb") as file:
            for seq, chunk in enumerate(chunks):
                if (chunk["seq"], chunk["offset"]) != (seq, file.tell()):
                    yield f"{name}: chunk {chunk['seq']} is not where chunk {seq} should be"
                if hashlib.sha256(file.read(chunk["length"])).hexdigest() != chunk["sha256"]:
                    yield f"{name}: chunk {seq} is not what was acknowledged"
            if not is_open and file.read(1):
                yield f"{name}: bytes behind its last chunk"


def _database_problems(connection: Connection) -> Iterator[str]:
    for row in connection.exec_driver_sql("PRAGMA integrity_check"):
        if row[0] != "ok":
            yield f"rows: {row[0]}"
    for row in connection.exec_driver_sql("PRAGMA foreign_key_check"):
        yield f"rows: {row[0]} names a row of {row[2]} that does not exist"


def _version_problems(connection: Connection) -> Iterator[str]:
    unfinished = set(connection.scalars(select(OPERATION.c.id).where(_is_unfinished())))
    begun = {row.id: row.version_count for row in connection.execute(select(MAP))}
    for row in connection.execute(select(MAP_VERSION)).mappings():
        name = f"version {row['map_id']} v{row['version']}"
        state = VersionState(row["state"])
        is_at_work = state in (VersionState.CREATING, VersionState.PREVIEW)
        if is_at_work != (row["operation_id"] in unfinished):
            found = "runs" if not is_at_work else "has ended"
            yield f"{name}: {state.value}, but its operation {found}"
        if state.is_usable and not row["sha256"]:
            yield f"{name}: {state.value} without a map file"
        if row["version"] > begun[row["map_id"]]:
            yield f"{name}: its map counts {begun[row['map_id']]} versions"


def _alias_problems(connection: Connection) -> Iterator[str]:
    same = (MAP_VERSION.c.map_id == MAP_ALIAS.c.map_id) & (
        MAP_VERSION.c.version == MAP_ALIAS.c.version
    )
    dangling = select(MAP_ALIAS).where(~exists().where(same))
    for row in connection.execute(dangling):
        yield f"map {row.map_id}: {row.alias} names v{row.version}, which does not exist"


def _operation_problems(connection: Connection) -> Iterator[str]:
    at_work = (TaskState.READY.value, TaskState.LEASED.value)
    query = (
        select(OPERATION.c.id, OPERATION.c.state, func.count(TASK.c.id).label("task_count"))
        .outerjoin(TASK, (TASK.c.operation_id == OPERATION.c.id) & TASK.c.state.in_(at_work))
        .group_by(OPERATION.c.id)
    )
    for row in connection.execute(query):
        expected = 0 if OperationState(row.state).is_final else 1
        if row.task_count != expected:
            yield f"operation {row.id}: {row.state} with {row.task_count} tasks to do"
    times = select(OPERATION.c.id).where(_is_unfinished() == (OPERATION.c.end_time_us > 0))
    for operation_id in connection.scalars(times):
        yield f"operation {operation_id}: state and end do not agree"


def _chunks(connection: Connection, uid: str) -> list[RowMapping]:
    query = select(EVENT_CHUNK).where(EVENT_CHUNK.c.stream_uid == uid).order_by(EVENT_CHUNK.c.seq)
    return list(connection.execute(query).mappings())


def _unequal(name: str, column: str, row: RowMapping, found: Any) -> Iterator[str]:
    if row[column] != found:
        yield f"{name}: {column} is {row[column]}, but its parts have {found}"


def _is_unfinished() -> Any:
    return OPERATION.c.state.in_([state.value for state in UNFINISHED])
