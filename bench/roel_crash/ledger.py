"""What the server acknowledged, and whether it still holds."""

from __future__ import annotations

import hashlib
import tempfile
import threading
from dataclasses import dataclass, field
from pathlib import Path

from roel_client import Client
from roel_service.errors import NotFoundError, RoelError
from roel_service.v1 import events_pb2, maps_pb2, types_pb2


@dataclass
class Ledger:
    """Facts by resource name; safe between threads.

    Attributes:
        events: recording to events acknowledged.
        digests: frozen recording to its digest.
        blobs: digest of an uploaded file to its size.
        maps: version to the digest of its map file.
        ends: operation to how it ended.
        broken: promises that were not kept, one line each.
    """

    events: dict[str, int] = field(default_factory=dict)
    digests: dict[str, str] = field(default_factory=dict)
    blobs: dict[str, int] = field(default_factory=dict)
    maps: dict[str, str] = field(default_factory=dict)
    ends: dict[str, str] = field(default_factory=dict)
    broken: list[str] = field(default_factory=list)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def note_events(self, stream: str, event_count: int) -> None:
        """So many events are durable."""
        with self._lock:
            self.events[stream] = max(event_count, self.events.get(stream, 0))

    def note_frozen(self, stream: events_pb2.EventStream) -> None:
        """A recording is frozen."""
        with self._lock:
            self.digests[stream.name] = stream.digest

    def note_blob(self, blob: types_pb2.BlobRef) -> None:
        """A file is there as a whole."""
        with self._lock:
            self.blobs[blob.sha256] = blob.size_bytes

    def forget(self, stream: str) -> None:
        """A recording is about to be deleted."""
        with self._lock:
            del self.events[stream], self.digests[stream]

    def note_map(self, version: maps_pb2.MapVersion) -> None:
        """A version is complete."""
        with self._lock:
            self.maps[version.name] = version.map.sha256

    def note_end(self, operation: str, end: str) -> None:
        """An operation has ended; it must never be told to have ended otherwise."""
        with self._lock:
            if self.ends.setdefault(operation, end) != end:
                self.broken.append(f"{operation} ended as {self.ends[operation]} and as {end}")

    def check(self, client: Client, newest_count: int | None = None) -> None:
        """Ask a server for everything; what it does not know any more is a broken promise.

        Args:
            newest_count: look only at so many of each kind; None looks at all.
        """
        newest = slice(-newest_count if newest_count else None, None)
        with self._lock:
            events, digests = list(self.events.items())[newest], list(self.digests.items())[newest]
            maps, blobs = list(self.maps.items())[newest], list(self.blobs.items())[newest]
        for name, event_count in events:
            is_kept = event_count <= self._found(client, name).event_count
            self._expect(name, is_kept or name not in self.events, "lost events")
        for name, digest in digests:
            is_kept = digest == self._found(client, name).digest
            self._expect(name, is_kept or name not in self.digests, "another digest")
        for name, sha256 in maps:
            found = hashlib.sha256(client.download_map(name)).hexdigest()
            self._expect(name, found == sha256, "another map")
        with tempfile.TemporaryDirectory() as folder:
            for sha256, size_bytes in blobs:
                path = Path(folder, sha256)
                client.download_blob(sha256, path)
                self._expect(sha256, path.stat().st_size == size_bytes, "another size")
                path.unlink()

    def _found(self, client: Client, name: str) -> events_pb2.EventStream:
        try:
            return client.event_stream(name)
        except NotFoundError:
            return events_pb2.EventStream()

    def _expect(self, name: str, is_kept: bool, problem: str) -> None:
        if not is_kept:
            with self._lock:
                self.broken.append(f"{name}: {problem}")


def end_of(error: RoelError) -> str:
    """How an operation ended that failed."""
    return f"{type(error).__name__} {error.reason}"
