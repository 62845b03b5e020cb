"""Uploads and downloads as state machines: what to send next, and what is durable.

They survive broken calls. What is under way is bounded by the server's credit; what is not
acknowledged is kept, so that nothing is encoded twice and nothing acknowledged is sent again.
"""

from __future__ import annotations

import hashlib
import os
import zlib
from collections import deque
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from roel_service.errors import CorruptionError, InputError, UnavailableError
from roel_service.in_order import in_order
from roel_service.progress import Progress, ProgressCallback
from roel_service.scene.events import EventSlice, EventSource, EventStream
from roel_service.scene.lines import LineMap
from roel_service.v1 import blobs_pb2, events_pb2, maps_pb2, types_pb2
from roel_service.wire import names
from roel_service.wire.chunks import decode_chunk, encode_chunk, split_chunks

# More threads than this would encode faster than any server checks.
MAX_ENCODER_COUNT = 4

# The most that a server takes at a time.
BLOB_PART_BYTES = 2**20


@dataclass(frozen=True, kw_only=True)
class EncodedChunk:
    """One chunk of a source; `data` is empty where the server had it before it was encoded."""

    seq: int
    event_count: int
    data: bytes

    def request(self) -> events_pb2.AppendEventsRequest:
        """The message that carries it."""
        chunk = events_pb2.EventChunk(seq=self.seq, data=self.data)
        return events_pb2.AppendEventsRequest(chunk=chunk)


class EventUpload:
    """A source on its way into one recording, read once and encoded ahead in threads.

    A recording that holds chunks already is taken to hold the first ones of this source.

    Attributes:
        committed_seq: chunks with a lower number are durable.
    """

    def __init__(self, source: EventSource, progress: ProgressCallback) -> None:
        self.committed_seq = 0
        self._progress = progress
        self._encoded = self._encode(source)
        self._pending: deque[EncodedChunk] = deque()
        self._unsent: deque[EncodedChunk] = deque()
        self._credit_chunks = 0
        self._durable_event_count = 0
        self._told_event_count = 0

    def close(self) -> None:
        """Stop encoding."""
        self._encoded.close()

    def restart(self, status: events_pb2.AppendStatus | None) -> None:
        """A new call began with this status."""
        self._unsent = self._pending.copy()
        self.acknowledge(status)

    def acknowledge(self, status: events_pb2.AppendStatus | None) -> None:
        """The server said what is durable; raises `UnavailableError` if it said nothing."""
        if status is None:
            raise UnavailableError("upload", "an acknowledgement", "the end of the call")
        self.committed_seq = status.committed_seq
        self._credit_chunks = status.credit_chunks
        self._forget_durable()
        if self._durable_event_count > self._told_event_count:
            count = self._told_event_count = self._durable_event_count
            told = Progress(stage="upload", done_count=count, total_count=0, fraction=0.0)
            self._progress(told)

    def next_chunk(self) -> EncodedChunk | None:
        """What to send next, None after the last; takes as long as reading and encoding take."""
        while (chunk := self._next()) is not None:
            if chunk.seq >= self.committed_seq:
                return chunk
            self._forget_durable()
        return None

    def has_credit(self, chunk: EncodedChunk) -> bool:
        """Whether the server would take the chunk now."""
        return chunk.seq < self.committed_seq + self._credit_chunks

    def _next(self) -> EncodedChunk | None:
        if self._unsent:
            return self._unsent.popleft()
        chunk = next(self._encoded, None)
        if chunk is not None:
            self._pending.append(chunk)
        return chunk

    def _forget_durable(self) -> None:
        while self._pending and self._pending[0].seq < self.committed_seq:
            self._durable_event_count += self._pending.popleft().event_count

    def _encode(self, source: EventSource) -> Generator[EncodedChunk, None, None]:
        encoder_count = min(os.cpu_count() or 1, MAX_ENCODER_COUNT)
        yield from in_order(self._encoded_chunk, enumerate(split_chunks(source)), encoder_count)

    def _encoded_chunk(self, numbered: tuple[int, EventStream]) -> EncodedChunk:
        seq, events = numbered
        data = b"" if seq < self.committed_seq else encode_chunk(events)
        return EncodedChunk(seq=seq, event_count=len(events), data=data)


class BlobUpload:
    """A file on its way into a blob.

    Attributes:
        blob: what it is to become.
        committed_bytes: so many of its bytes are durable.
    """

    def __init__(self, path: Path, progress: ProgressCallback) -> None:
        self._path = path
        self._progress = progress
        self._offset = 0
        self._credit_bytes = 0
        self.committed_bytes = 0
        with path.open("rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        self.blob = types_pb2.BlobRef(sha256=sha256, size_bytes=path.stat().st_size)

    def header(self) -> blobs_pb2.WriteBlobRequest:
        """The first message; equal files continue one upload."""
        upload_id = f"file-{self.blob.sha256[:32]}"
        header = blobs_pb2.WriteBlobHeader(
            parent=names.PROJECT, blob=self.blob, upload_id=upload_id
        )
        return blobs_pb2.WriteBlobRequest(header=header)

    def restart(self, status: blobs_pb2.WriteStatus | None) -> None:
        """A new call began with this status."""
        self.acknowledge(status)
        self._offset = self.committed_bytes

    def acknowledge(self, status: blobs_pb2.WriteStatus | None) -> None:
        """The server said what is durable; raises `UnavailableError` if it said nothing."""
        if status is None:
            raise UnavailableError("upload", "an acknowledgement", "the end of the call")
        self._credit_bytes = status.credit_bytes
        self.committed_bytes = status.committed_bytes
        size_bytes = self.blob.size_bytes
        told = Progress(
            stage="upload",
            done_count=self.committed_bytes,
            total_count=size_bytes,
            fraction=self.committed_bytes / size_bytes if size_bytes else 1.0,
        )
        self._progress(told)

    def next_part(self) -> blobs_pb2.WriteBlobRequest | None:
        """What to send next, None after the last."""
        with self._path.open("rb") as file:
            file.seek(self._offset)
            data = file.read(BLOB_PART_BYTES)
        part = blobs_pb2.BlobPart(offset=self._offset, data=data, crc32=zlib.crc32(data))
        self._offset += len(data)
        return blobs_pb2.WriteBlobRequest(data=part) if data else None

    def has_credit(self) -> bool:
        """Whether the server would take what `next_part` gave last."""
        return self._offset <= self.committed_bytes + self._credit_bytes


class BlobDownload:
    """A blob on its way into a file, which appears when it is whole.

    Attributes:
        received_bytes: so many bytes are there.
    """

    def __init__(self, blob_sha256: str, path: Path) -> None:
        self._sha256 = blob_sha256
        self._path = path
        self._part = path.with_name(f"{path.name}.part")
        self._digest = hashlib.sha256()
        self.received_bytes = 0
        self._part.write_bytes(b"")

    def request(self) -> blobs_pb2.ReadBlobRequest:
        """Asks for what is missing."""
        return blobs_pb2.ReadBlobRequest(
            name=names.blob_name(self._sha256), offset=self.received_bytes
        )

    def receive(self, response: blobs_pb2.ReadBlobResponse) -> None:
        """The next bytes came."""
        with self._part.open("ab") as file:
            file.write(response.data)
        self._digest.update(response.data)
        self.received_bytes += len(response.data)

    def finish(self) -> None:
        """Give the file its name; raises `CorruptionError` unless it is what was asked for."""
        found = self._digest.hexdigest()
        if found != self._sha256:
            raise CorruptionError("blob", f"bytes of digest {self._sha256}", found)
        self._part.replace(self._path)

    def close(self) -> None:
        """Leave nothing half behind."""
        self._part.unlink(missing_ok=True)


class MapDownload:
    """A map version on its way into a file, which appears when it is whole."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._part = path.with_name(f"{path.name}.part")
        self._missing_bytes = 0
        self._part.write_bytes(b"")

    def receive(self, response: maps_pb2.ExportMapResponse) -> None:
        """The next bytes came; the first message tells how many there will be."""
        self._missing_bytes += response.size_bytes - len(response.data)
        with self._part.open("ab") as file:
            file.write(response.data)

    def finish(self) -> None:
        """Give the file its name; raises `UnavailableError` if something is missing."""
        if self._missing_bytes:
            found = f"{self._missing_bytes} bytes less"
            raise UnavailableError("export", "the whole file", found)
        self._part.replace(self._path)

    def close(self) -> None:
        """Leave nothing half behind."""
        self._part.unlink(missing_ok=True)


def map_format(name: str) -> int:
    """The number of an export format by its suffix; raises `InputError` for an unknown one."""
    numbers: dict[str, int] = {
        key.removeprefix("MAP_FORMAT_").lower(): number
        for key, number in maps_pb2.MapFormat.items()
    }
    known = [key for key, number in numbers.items() if number]
    if name not in known:
        raise InputError("format", f"one of {', '.join(known)}", repr(name[:40]))
    return numbers[name]


def lines_of_message(message: maps_pb2.GetLinesResponse) -> LineMap:
    """The lines of one message of GetLines."""
    return LineMap(
        segments=np.frombuffer(message.segments_m, "<f8").reshape(-1, 2, 3),
        observation_count=np.frombuffer(message.observation_count, "<i4"),
        rms_residual_px=np.frombuffer(message.rms_residual_px, "<f4"),
        sigma_m=np.frombuffer(message.sigma_m, "<f4"),
    )


def events_of_chunk(
    chunk: events_pb2.EventChunk, start_us: int | None, stop_us: int | None
) -> EventSlice:
    """The events of a chunk that lie in a time range; it may be open on either side."""
    events = decode_chunk(chunk.data, previous_t1_us=None)
    first_us, last_us = int(events.t_us[0]), int(events.t_us[-1])
    return events.between(
        first_us if start_us is None else start_us, last_us + 1 if stop_us is None else stop_us
    )
