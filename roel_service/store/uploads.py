"""Blobs that clients send: their way into the blob store, and what keeps them there unused."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from sqlalchemy import Connection, delete, func, insert, select, update
from sqlalchemy.dialects.sqlite import insert as upsert

from roel_service.errors import (
    ConflictError,
    CorruptionError,
    InputError,
    LimitError,
    NotFoundError,
    StateError,
)
from roel_service.failpoints import failpoint
from roel_service.store.blobs import BlobStore
from roel_service.store.database import Database
from roel_service.store.event_streams import writer_replaced
from roel_service.store.files import make_folder, sync_folder
from roel_service.store.locks import KeyedLocks
from roel_service.store.quotas import CALLER, check_stored_bytes
from roel_service.store.records import BlobRecord, UploadRecord, now_us, row_from_record
from roel_service.store.retention import DAY_US, UPLOAD_RETENTION_DAYS
from roel_service.store.schema import BLOB, UPLOAD


@dataclass(frozen=True, kw_only=True)
class Part:
    """Some bytes of a blob."""

    offset: int
    data: bytes


class Uploads:
    """Repository of uploads and of unused blobs. What a method changed is durable on return."""

    def __init__(self, database: Database, blobs: BlobStore, folder: Path) -> None:
        self._database = database
        self._blobs = blobs
        self._folder = folder
        self._locks = KeyedLocks()
        make_folder(folder)

    def take_over(
        self, upload_id: str, sha256: str, size_bytes: int, max_upload_count: int
    ) -> UploadRecord:
        """Become the one writer of an upload, which begins or goes on.

        Returns:
            The upload; its fence is the writer's licence to append.

        Raises:
            ConflictError: ALREADY_EXISTS, the id is that of another blob's upload.
            LimitError: TOO_MANY_UPLOADS, QUOTA_STORAGE.
        """
        self.delete_expired()
        with self._locks.holding(upload_id), self._database.write() as connection:
            record = _find(connection, upload_id)
            if record is None:
                _check_count(connection, max_upload_count)
                check_stored_bytes(connection, size_bytes)
                return self._begin(connection, upload_id, sha256, size_bytes)
            if (record.sha256, record.size_bytes) != (sha256, size_bytes):
                expected = f"an upload of {record.sha256}"
                raise ConflictError(upload_id, expected, sha256, reason="ALREADY_EXISTS")
            return _update(connection, record, fence=record.fence + 1)

    def append(self, upload_id: str, fence: int, parts: Sequence[Part]) -> UploadRecord:
        """Append parts; bytes that are there already are compared.

        Args:
            fence: of the record that `take_over` gave.

        Raises:
            NotFoundError: it has expired or ended.
            StateError: SEQUENCE_GAP with the offset that is expected.
            ConflictError: WRITER_REPLACED; CHUNK_CONFLICT, other bytes than those already there.
            InputError: PART_INVALID, more bytes than the blob was said to have.
        """
        with self._locks.holding(upload_id):
            record = self._writable(upload_id, fence)
            committed_bytes = self._write(record, parts)
            with self._database.write() as connection:
                return _update(connection, record, committed_bytes=committed_bytes)

    def finish(self, upload_id: str, fence: int) -> BlobRecord:
        """Make a blob of an upload that is whole.

        Raises:
            NotFoundError, ConflictError: as `append`.
            StateError: SEQUENCE_GAP, bytes are missing.
            CorruptionError: the bytes have another digest; the upload is forgotten.
        """
        with self._locks.holding(upload_id):
            record = self._writable(upload_id, fence)
            if record.committed_bytes < record.size_bytes:
                raise _gap(record.committed_bytes, record.size_bytes)
            try:
                self._blobs.adopt(self._path(upload_id), record.sha256)
            except CorruptionError:
                self._forget([upload_id])
                raise
            with self._database.write() as connection:
                blob = _used(connection, record.sha256, record.size_bytes, record.owner)
            self._forget([upload_id])
            return blob

    def get(self, upload_id: str) -> UploadRecord:
        """One upload that has not ended; raises `NotFoundError`."""
        with self._database.read() as connection:
            return _get(connection, upload_id)

    def use(self, sha256: str) -> BlobRecord:
        """A blob, which is kept for another day whatever names it; raises `NotFoundError`."""
        # In a transaction: nobody sweeps meanwhile.
        with self._database.write() as connection:
            path = self._blobs.path(sha256)
            if not path.exists():
                raise NotFoundError("blob", "an existing one", sha256)
            return _used(connection, sha256, path.stat().st_size)

    def path(self, blob: BlobRecord) -> Path:
        """The file of a blob."""
        return self._blobs.path(blob.sha256)

    def delete_expired(self) -> None:
        """Forget uploads that nobody continued, and unused blobs; a sweep deletes their files."""
        now = now_us()
        unused = BLOB.c.last_used_us <= now - UPLOAD_RETENTION_DAYS * DAY_US
        expired = select(UPLOAD.c.id).where(UPLOAD.c.expire_time_us <= now)
        with self._database.write() as connection:
            connection.execute(delete(BLOB).where(unused))
            upload_ids = list(connection.scalars(expired))
        self._forget(upload_ids)

    def recover(self) -> None:
        """Delete files of uploads that have ended, and cut the others to what was committed."""
        with self._database.read() as connection:
            rows = connection.execute(select(UPLOAD.c.id, UPLOAD.c.committed_bytes))
            committed_bytes = {row.id: row.committed_bytes for row in rows}
        for path in self._folder.glob("*.upload"):
            if path.stem not in committed_bytes:
                path.unlink()
            elif path.stat().st_size > committed_bytes[path.stem]:
                os.truncate(path, committed_bytes[path.stem])

    def _path(self, upload_id: str) -> Path:
        return self._folder / f"{upload_id}.upload"

    def _begin(
        self, connection: Connection, upload_id: str, sha256: str, size_bytes: int
    ) -> UploadRecord:
        record = UploadRecord(
            id=upload_id,
            sha256=sha256,
            size_bytes=size_bytes,
            committed_bytes=0,
            fence=1,
            expire_time_us=_expire_time_us(),
            owner=CALLER.get().name,
        )
        self._path(upload_id).touch()
        sync_folder(self._folder)
        connection.execute(insert(UPLOAD), row_from_record(record))
        return record

    def _writable(self, upload_id: str, fence: int) -> UploadRecord:
        record = self.get(upload_id)
        if record.fence != fence:
            raise writer_replaced(upload_id)
        return record

    def _write(self, record: UploadRecord, parts: Sequence[Part]) -> int:
        """Write parts durably behind the committed bytes; the bytes that are there then."""
        position = record.committed_bytes
        with self._path(record.id).open("r+b") as file:
            file.truncate(position)
            for part in parts:
                position = _write_part(file, part, position, record.size_bytes)
            file.flush()
            failpoint("upload.written")
            os.fsync(file.fileno())
            failpoint("upload.synced")
        return position

    def _forget(self, upload_ids: Sequence[str]) -> None:
        with self._database.write() as connection:
            connection.execute(delete(UPLOAD).where(UPLOAD.c.id.in_(upload_ids)))
        for upload_id in upload_ids:
            self._path(upload_id).unlink(missing_ok=True)


def _write_part(file: BinaryIO, part: Part, position: int, size_bytes: int) -> int:
    """Compare what a part repeats and write the rest; the end of the bytes then."""
    end = part.offset + len(part.data)
    if part.offset > position:
        raise _gap(position, part.offset)
    if part.offset < 0 or end > size_bytes:
        expected = f"bytes from 0 to {size_bytes}"
        found = f"bytes from {part.offset} to {end}"
        raise InputError("part", expected, found, reason="PART_INVALID")
    file.seek(part.offset)
    repeated = part.data[: position - part.offset]
    if file.read(len(repeated)) != repeated:
        expected = "the bytes that were stored"
        found = f"other bytes at {part.offset}"
        raise ConflictError("part", expected, found, reason="CHUNK_CONFLICT")
    file.seek(position)
    file.write(part.data[len(repeated) :])
    return max(position, end)


def _gap(expected_offset: int, found_offset: int) -> StateError:
    return StateError("offset", f"{expected_offset}", f"{found_offset}", reason="SEQUENCE_GAP")


def _find(connection: Connection, upload_id: str) -> UploadRecord | None:
    query = select(UPLOAD).where(UPLOAD.c.id == upload_id)
    row = connection.execute(query).mappings().one_or_none()
    return None if row is None else UploadRecord(**row)


def _get(connection: Connection, upload_id: str) -> UploadRecord:
    record = _find(connection, upload_id)
    if record is None:
        raise NotFoundError("upload", "one that goes on", upload_id)
    return record


def _check_count(connection: Connection, max_count: int) -> None:
    count = connection.execute(select(func.count()).select_from(UPLOAD)).scalar_one()
    if count >= max_count:
        expected = f"at most {max_count} at a time"
        raise LimitError("uploads", expected, f"{count + 1}", reason="TOO_MANY_UPLOADS")


def _update(connection: Connection, record: UploadRecord, **values: Any) -> UploadRecord:
    changes = {**values, "expire_time_us": _expire_time_us()}
    connection.execute(update(UPLOAD).where(UPLOAD.c.id == record.id).values(changes))
    return dataclasses.replace(record, **changes)


def _expire_time_us() -> int:
    return now_us() + UPLOAD_RETENTION_DAYS * DAY_US


def _used(connection: Connection, sha256: str, size_bytes: int, owner: str = "") -> BlobRecord:
    """Note that a blob is used now."""
    now = now_us()
    fresh = BlobRecord(
        sha256=sha256,
        size_bytes=size_bytes,
        create_time_us=now,
        last_used_us=now,
        owner=owner,
    )
    statement = upsert(BLOB).values(row_from_record(fresh))
    changed = statement.on_conflict_do_update(set_={"last_used_us": now}).returning(BLOB)
    return BlobRecord(**connection.execute(changed).mappings().one())
