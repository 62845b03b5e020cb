"""Uploads as state machines without input or output: what to send next, and what is durable.

They survive broken calls. What is under way is bounded by the server's credit; what is not
acknowledged is kept, so that nothing is encoded twice and nothing acknowledged is sent again.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Generator
from dataclasses import dataclass

from roel_service.errors import UnavailableError
from roel_service.in_order import in_order
from roel_service.progress import Progress, ProgressCallback
from roel_service.scene.events import EventSource, EventStream
from roel_service.v1 import events_pb2
from roel_service.wire.chunks import encode_chunk, split_chunks

# More threads than this would encode faster than any server checks.
MAX_ENCODER_COUNT = 4


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
