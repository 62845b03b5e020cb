"""A file of events as the chunks of a recording; runs in a child, since the file may be hostile."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path

from roel_service.errors import LimitError
from roel_service.in_order import in_order
from roel_service.io.events import open_events
from roel_service.jobs.task import Tell
from roel_service.progress import Progress
from roel_service.store.event_imports import ImportedEvents
from roel_service.store.event_streams import ChunkFacts
from roel_service.wire.chunks import check_chunk, encode_chunk, split_chunks

STAGE = "import"

# What errors call the file, whose name in the store tells nobody anything.
SUBJECT = "imported file"


@dataclass(frozen=True, kw_only=True)
class EventImportParameters:
    """What to import.

    Attributes:
        file: the bytes that were sent.
        width, height: of the recording's sensor, px.
        target: where the chunks go.
        max_size_bytes: most of them.
        fence: given back with the result.
    """

    file: Path
    width: int
    height: int
    target: Path
    max_size_bytes: int
    fence: int


def run_event_import(parameters: EventImportParameters, tell: Tell) -> ImportedEvents:
    """Entry point of an import.

    Raises:
        EventsError: a file that is damaged, of an unknown format, or not of this sensor.
        LimitError: EVENT_STREAM_TOO_LARGE.
    """
    source = open_events(parameters.file, parameters.width, parameters.height, subject=SUBJECT)
    chunks: list[ChunkFacts] = []
    size_bytes = event_count = 0
    with parameters.target.open("wb") as target:
        for data in in_order(encode_chunk, split_chunks(source), 1):
            size_bytes += len(data)
            _check_size(size_bytes, parameters.max_size_bytes)
            target.write(data)
            chunks.append(_facts(len(chunks), data))
            event_count += chunks[-1].event_count
            tell(_progress(event_count, source.event_count or 0))
        target.flush()
        os.fsync(target.fileno())
    return ImportedEvents(fence=parameters.fence, file=parameters.target, chunks=chunks)


def _check_size(size_bytes: int, max_size_bytes: int) -> None:
    if size_bytes > max_size_bytes:
        expected = f"at most {max_size_bytes} bytes of events"
        reason = "EVENT_STREAM_TOO_LARGE"
        raise LimitError(SUBJECT, expected, "more", reason=reason)


def _facts(seq: int, data: bytes) -> ChunkFacts:
    summary = check_chunk(data)
    return ChunkFacts(
        seq=seq,
        t0_us=summary.t0_us,
        t1_us=summary.t1_us,
        event_count=summary.event_count,
        longest_step_us=summary.longest_step_us,
        length=len(data),
        sha256=hashlib.sha256(data).hexdigest(),
    )


def _progress(done_count: int, total_count: int) -> Progress:
    fraction = done_count / total_count if total_count else 0.0
    return Progress(
        stage=STAGE, done_count=done_count, total_count=total_count, fraction=min(fraction, 1.0)
    )
