"""BlobService: files arrive and are fetched."""

from __future__ import annotations

import asyncio
import hashlib
import zlib
from collections.abc import AsyncIterator, Sequence
from pathlib import Path
from typing import Any

from roel_service.errors import CorruptionError, InputError, LimitError, NotFoundError
from roel_service.service.settings import Settings
from roel_service.service.uploads import OpenUploads, Upload, next_request, request_part
from roel_service.store.records import BlobRecord, UploadRecord
from roel_service.store.uploads import Part, Uploads
from roel_service.v1 import blobs_pb2, types_pb2
from roel_service.wire import names

# Digests of one FindMissingBlobs.
MAX_DIGEST_COUNT = 1000


class BlobServicer:
    """Decodes requests, calls the store in a thread, encodes answers."""

    def __init__(self, uploads: Uploads, open_uploads: OpenUploads, settings: Settings) -> None:
        self._uploads = uploads
        self._open_uploads = open_uploads
        self._settings = settings

    async def FindMissingBlobs(
        self, request: blobs_pb2.FindMissingBlobsRequest, context: Any
    ) -> blobs_pb2.FindMissingBlobsResponse:
        names.check_parent(request.parent)
        if len(request.sha256) > MAX_DIGEST_COUNT:
            found = f"{len(request.sha256)}"
            raise LimitError("sha256", f"at most {MAX_DIGEST_COUNT} digests", found)
        digests = [names.checked_sha256(sha256) for sha256 in request.sha256]
        missing = await asyncio.to_thread(self._missing, digests)
        return blobs_pb2.FindMissingBlobsResponse(missing_sha256=missing)

    async def WriteBlob(
        self, requests: AsyncIterator[blobs_pb2.WriteBlobRequest], context: Any
    ) -> AsyncIterator[blobs_pb2.WriteStatus]:
        header = await self._header(requests)
        blob = await asyncio.to_thread(self._find, header.blob.sha256)
        if blob is not None:
            yield _whole(blob)
            return
        record = await asyncio.to_thread(
            self._uploads.take_over,
            names.checked_id(header.upload_id, "upload_id"),
            header.blob.sha256,
            header.blob.size_bytes,
            self._settings.open_uploads,
        )
        sink = BlobSink(self._uploads, record, self._settings)
        upload = Upload(requests, sink, self._settings)
        with self._open_uploads.entered(f"upload {record.id}", record.fence, upload):
            yield _under_way(record, self._settings)
            async for status in upload.statuses():
                yield status

    async def QueryWriteStatus(
        self, request: blobs_pb2.QueryWriteStatusRequest, context: Any
    ) -> blobs_pb2.WriteStatus:
        names.check_parent(request.parent)
        upload_id = names.checked_id(request.upload_id, "upload_id")
        return _under_way(await asyncio.to_thread(self._uploads.get, upload_id), self._settings)

    async def ReadBlob(
        self, request: blobs_pb2.ReadBlobRequest, context: Any
    ) -> AsyncIterator[blobs_pb2.ReadBlobResponse]:
        blob = await asyncio.to_thread(self._uploads.use, names.blob_sha256(request.name))
        start, stop = _range(request, blob)
        digest = hashlib.sha256()
        size = self._settings.blob_part_bytes
        for offset in range(start, stop, size):
            length = min(size, stop - offset)
            path = self._uploads.path(blob)
            data = await asyncio.to_thread(_read, path, offset, length, digest)
            yield blobs_pb2.ReadBlobResponse(data=data)
        if (start, stop) == (0, blob.size_bytes) and digest.hexdigest() != blob.sha256:
            raise CorruptionError(f"blob {blob.sha256}", "bytes of that digest", digest.hexdigest())

    async def _header(
        self, requests: AsyncIterator[blobs_pb2.WriteBlobRequest]
    ) -> blobs_pb2.WriteBlobHeader:
        request = await next_request(requests, self._settings)
        if request is None:
            raise InputError("upload", "a message that names the blob", "none")
        header: blobs_pb2.WriteBlobHeader = request_part(request, "header")
        names.check_parent(header.parent)
        names.checked_sha256(header.blob.sha256)
        if not 0 <= header.blob.size_bytes <= self._settings.blob_bytes:
            expected = f"at most {self._settings.blob_bytes} bytes"
            found = f"{header.blob.size_bytes}"
            raise LimitError("blob", expected, found, reason="BLOB_TOO_LARGE")
        return header

    def _missing(self, digests: Sequence[str]) -> list[str]:
        return [sha256 for sha256 in digests if self._find(sha256) is None]

    def _find(self, sha256: str) -> BlobRecord | None:
        try:
            return self._uploads.use(sha256)
        except NotFoundError:
            return None


class BlobSink:
    """A blob on its way, with the licence to append to it (see `Sink`); a byte costs 1.

    The item of the last message is None.
    """

    def __init__(self, uploads: Uploads, record: UploadRecord, settings: Settings) -> None:
        self.credit = settings.blob_credit_bytes
        self._uploads = uploads
        self._record = record
        self._settings = settings

    def cost(self, request: blobs_pb2.WriteBlobRequest) -> int:
        return len(request.data.data)

    def check(self, request: blobs_pb2.WriteBlobRequest) -> Part | None:
        if request.WhichOneof("part") == "finish":
            return None
        message: blobs_pb2.BlobPart = request_part(request, "data")
        part = Part(offset=message.offset, data=message.data)
        _check_part(part, message.crc32, self._settings.blob_part_bytes)
        return part

    def size_bytes(self, item: Part | None) -> int:
        return 0 if item is None else len(item.data)

    def commit(self, items: list[Part | None]) -> blobs_pb2.WriteStatus:
        parts = [part for part in items if part is not None]
        if parts:
            self._record = self._uploads.append(self._record.id, self._record.fence, parts)
        if len(parts) < len(items):
            return _whole(self._uploads.finish(self._record.id, self._record.fence))
        return _under_way(self._record, self._settings)


def _check_part(part: Part, crc32: int, max_bytes: int) -> None:
    if len(part.data) > max_bytes:
        expected = f"at most {max_bytes} bytes"
        raise LimitError("part", expected, f"{len(part.data)}", reason="BLOB_TOO_LARGE")
    found = zlib.crc32(part.data)
    if found != crc32:
        expected = f"bytes of CRC {crc32:#010x}"
        raise InputError("part", expected, f"{found:#010x}", reason="PART_CRC_MISMATCH")


def _range(request: blobs_pb2.ReadBlobRequest, blob: BlobRecord) -> tuple[int, int]:
    """First byte to send, and the one behind the last."""
    if not 0 <= request.offset <= blob.size_bytes:
        expected = f"an offset from 0 to {blob.size_bytes}"
        raise InputError("offset", expected, f"{request.offset}")
    if request.limit_bytes < 0:
        raise InputError("limit_bytes", "a length of at least 0", f"{request.limit_bytes}")
    length = request.limit_bytes or blob.size_bytes
    return request.offset, min(request.offset + length, blob.size_bytes)


def _read(path: Path, offset: int, length: int, digest: Any) -> bytes:
    """Part of a file, which is added to a digest."""
    with path.open("rb") as file:
        file.seek(offset)
        data = file.read(length)
    digest.update(data)
    return data


def _whole(blob: BlobRecord) -> blobs_pb2.WriteStatus:
    reference = types_pb2.BlobRef(sha256=blob.sha256, size_bytes=blob.size_bytes)
    return blobs_pb2.WriteStatus(committed_bytes=blob.size_bytes, blob=reference)


def _under_way(record: UploadRecord, settings: Settings) -> blobs_pb2.WriteStatus:
    return blobs_pb2.WriteStatus(
        committed_bytes=record.committed_bytes, credit_bytes=settings.blob_credit_bytes
    )
