"""Event chunks: up to 131,072 events as one independent block, the same on the wire and on disk.

Little-endian. A 48-byte header (magic `REC1`, sizes, first and last time, CRC-32 of payload and
header) precedes one zstd frame of byte planes: time steps, x, y, polarity bits.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import zstandard

from roel_service.arrays import Array, IntArray
from roel_service.errors import EventsError
from roel_service.scene.events import EventSource, EventStream, concatenate
from roel_service.wire.byte_planes import (
    integers_from_planes,
    largest_of_planes,
    sum_of_planes,
    write_planes,
)
from roel_service.wire.plane_frames import compressed

MAX_CHUNK_EVENT_COUNT = 131_072
# Longest time between neighbours in a chunk: what four bytes hold.
MAX_STEP_US = 2**32 - 1
CHUNK_VERSION = 1

_MAGIC = b"REC1"
_COLUMNAR_ZSTD = 1
_HEADER = struct.Struct("<4sBBBBIIqqHHII")
# The header ends in the CRC of all its other bytes.
_CRC = struct.Struct("<I")
_HEADER_BYTES = _HEADER.size + _CRC.size

_SUBJECT = "event chunk"


class _Header(NamedTuple):
    """The fields of `_HEADER`, in its order."""

    magic: bytes
    version: int
    encoding: int
    width_bytes: int
    flags: int
    event_count: int
    payload_length: int
    t0_us: int
    t1_us: int
    width: int
    height: int
    payload_crc: int
    reserved: int


class _Planes(NamedTuple):
    """A payload and its parts, uint8 each: planes of three columns, and polarity bits."""

    all: Array
    steps: Array
    x: Array
    y: Array
    signs: Array


@dataclass(frozen=True, kw_only=True)
class ChunkSummary:
    """What is worth knowing of a chunk without its events.

    Attributes:
        t0_us, t1_us: first and last event.
        width, height: sensor size, px.
        longest_step_us: longest time between two neighbouring events.
    """

    event_count: int
    t0_us: int
    t1_us: int
    width: int
    height: int
    longest_step_us: int


def split_chunks(source: EventSource) -> Iterator[EventStream]:
    """Cut a recording into streams that `encode_chunk` accepts.

    The cuts depend on the events alone, not on the chunks in which the source delivers them.
    """
    # Fewer events than a chunk takes, without a jump.
    waiting: list[EventStream] = []
    for run in _runs(source):
        if waiting and _is_jump(waiting[-1].t_us[-1], run.t_us[0]):
            yield _joined(waiting)
            waiting = []
        start = min(len(run), MAX_CHUNK_EVENT_COUNT - sum(map(len, waiting)))
        waiting.append(run.part(0, start))
        while sum(map(len, waiting)) == MAX_CHUNK_EVENT_COUNT:
            yield _joined(waiting)
            stop = min(len(run), start + MAX_CHUNK_EVENT_COUNT)
            waiting = [run.part(start, stop)] if start < stop else []
            start = stop
    if waiting:
        yield _joined(waiting)


def _runs(source: EventSource) -> Iterator[EventStream]:
    """The events of a source in parts without jumps."""
    for chunk in source.chunks():
        if len(chunk) == 0:
            continue
        cuts = [0, len(chunk)]
        # Hardly any recording is long enough for a jump; looking for one costs a pass over all.
        if _is_jump(chunk.t_us[0], chunk.t_us[-1]):
            jumps = np.flatnonzero(np.diff(chunk.t_us) > MAX_STEP_US) + 1
            cuts[1:1] = jumps.tolist()
        for start, stop in pairwise(cuts):
            yield chunk.part(start, stop)


def _is_jump(before_us: int, after_us: int) -> bool:
    """Whether two neighbours are too far apart for one chunk."""
    return after_us - before_us > MAX_STEP_US


def _joined(parts: list[EventStream]) -> EventStream:
    return parts[0] if len(parts) == 1 else concatenate(parts)


def encode_chunk(events: EventStream) -> bytes:
    """Encode 1 to `MAX_CHUNK_EVENT_COUNT` events.

    Raises:
        EventsError: CHUNK_MALFORMED; another count, or a step above `MAX_STEP_US`.
    """
    count = len(events)
    if not 1 <= count <= MAX_CHUNK_EVENT_COUNT:
        raise _malformed(f"1 to {MAX_CHUNK_EVENT_COUNT} events", f"{count}")
    steps_us, width_bytes = _steps(events.t_us)
    payload_bytes = _payload_bytes(width_bytes, count)
    planes = _parted(np.empty(payload_bytes, np.uint8), width_bytes, count)
    write_planes(steps_us, width_bytes, planes.steps)
    write_planes(events.x, 2, planes.x)
    write_planes(events.y, 2, planes.y)
    planes.signs[:] = np.packbits(events.polarity > 0, bitorder="little")
    payload = compressed(planes.all, width_bytes, count)
    header = _HEADER.pack(
        *_Header(
            magic=_MAGIC,
            version=CHUNK_VERSION,
            encoding=_COLUMNAR_ZSTD,
            width_bytes=width_bytes,
            flags=0,
            event_count=count,
            payload_length=len(payload),
            t0_us=int(events.t_us[0]),
            t1_us=int(events.t_us[-1]),
            width=events.width,
            height=events.height,
            payload_crc=zlib.crc32(payload),
            reserved=0,
        )
    )
    return header + _CRC.pack(zlib.crc32(header)) + payload


def _steps(t_us: IntArray) -> tuple[Array, int]:
    """(K,) unsigned steps between neighbours, the first one 0, and how many bytes they take.

    Raises:
        EventsError: CHUNK_MALFORMED, a step above `MAX_STEP_US`.
    """
    duration_us = int(t_us[-1]) - int(t_us[0])
    for width_bytes in (2, 4):
        # Steps modulo 256^width, several times faster than in 64 bits; one that is cut is missing in
        # the sum.
        lowest = t_us.astype(f"u{width_bytes}")
        steps_us = np.zeros_like(lowest)
        np.subtract(lowest[1:], lowest[:-1], out=steps_us[1:])
        if int(steps_us.sum(dtype=np.uint64)) == duration_us:
            return steps_us, width_bytes
    longest_us = int(np.diff(t_us).max())
    raise _malformed(f"steps of at most {MAX_STEP_US} us", f"{longest_us} us")


def decode_chunk(data: bytes, *, previous_t1_us: int | None) -> EventStream:
    """Decode one chunk; nothing is allocated before the sizes are known to be true.

    Args:
        data: exactly one chunk.
        previous_t1_us: last time of the chunk before, None for the first.

    Raises:
        EventsError: UNSUPPORTED_ENCODING, CHUNK_CRC_MISMATCH, CHUNK_MALFORMED,
            EVENT_TIME_NOT_MONOTONE or EVENT_OUT_OF_BOUNDS.
    """
    header, planes = _opened(data)
    if previous_t1_us is not None and header.t0_us < previous_t1_us:
        raise EventsError(
            _SUBJECT,
            f"times from {previous_t1_us} us, where the chunk before ends",
            f"{header.t0_us} us",
            reason="EVENT_TIME_NOT_MONOTONE",
        )
    return EventStream(
        t_us=_times(integers_from_planes(planes.steps, header.width_bytes), header),
        x=integers_from_planes(planes.x, 2),
        y=integers_from_planes(planes.y, 2),
        polarity=_polarity(planes.signs, header.event_count),
        width=header.width,
        height=header.height,
    )


def check_chunk(data: bytes) -> ChunkSummary:
    """What a chunk holds, if `decode_chunk` accepts it; several times faster.

    Raises:
        EventsError: as `decode_chunk`.
    """
    header, planes = _opened(data)
    if not _is_sound(header, planes):
        decode_chunk(data, previous_t1_us=None)
    return ChunkSummary(
        event_count=header.event_count,
        t0_us=header.t0_us,
        t1_us=header.t1_us,
        width=header.width,
        height=header.height,
        longest_step_us=largest_of_planes(planes.steps, header.width_bytes),
    )


def _opened(data: bytes) -> tuple[_Header, _Planes]:
    """Header and decompressed payload of a chunk whose sizes and checksums are right."""
    header = _read_header(data)
    payload = memoryview(data)[_HEADER_BYTES:]
    if header.payload_length != len(payload):
        raise _malformed(f"a payload of {header.payload_length} bytes", f"{len(payload)}")
    _check_crc("payload", payload, header.payload_crc)
    size = _payload_bytes(header.width_bytes, header.event_count)
    decompressed = _decompressed(payload, size)
    return header, _parted(decompressed, header.width_bytes, header.event_count)


def _payload_bytes(width_bytes: int, count: int) -> int:
    return (width_bytes + 4) * count + -(-count // 8)


def _parted(payload: Array, width_bytes: int, count: int) -> _Planes:
    """A decompressed payload with views of its parts."""
    x, y, signs = (width * count for width in (width_bytes, width_bytes + 2, width_bytes + 4))
    return _Planes(payload, payload[:x], payload[x:y], payload[y:signs], payload[signs:])


def _is_sound(header: _Header, planes: _Planes) -> bool:
    """Whether `decode_chunk` would accept the planes, told without putting integers together."""
    width_bytes, count = header.width_bytes, header.event_count
    first_step_us = integers_from_planes(planes.steps[::count], width_bytes)[0]
    return bool(
        first_step_us == 0
        and sum_of_planes(planes.steps, width_bytes) == header.t1_us - header.t0_us
        and largest_of_planes(planes.x, 2) < header.width
        and largest_of_planes(planes.y, 2) < header.height
        and not _has_padding(planes.signs, count)
    )


def _read_header(data: bytes) -> _Header:
    if len(data) < _HEADER_BYTES:
        raise _malformed(f"at least {_HEADER_BYTES} bytes", f"{len(data)}")
    header = _Header(*_HEADER.unpack_from(data))
    if header.magic != _MAGIC:
        raise _malformed(f"the magic {_MAGIC!r}", f"{header.magic!r}")
    _check_crc("header", data[: _HEADER.size], _CRC.unpack_from(data, _HEADER.size)[0])
    if (header.version, header.encoding) != (CHUNK_VERSION, _COLUMNAR_ZSTD):
        expected = f"version {CHUNK_VERSION}, encoding {_COLUMNAR_ZSTD}"
        found = f"version {header.version}, encoding {header.encoding}"
        raise EventsError(_SUBJECT, expected, found, reason="UNSUPPORTED_ENCODING")
    if header.width_bytes not in (2, 4) or header.flags or header.reserved:
        found = f"{header.width_bytes}, {header.flags} and {header.reserved}"
        raise _malformed("2 or 4 bytes per time step, flags 0 and reserved 0", found)
    if not 1 <= header.event_count <= MAX_CHUNK_EVENT_COUNT:
        raise _malformed(f"1 to {MAX_CHUNK_EVENT_COUNT} events", f"{header.event_count}")
    return header


def _times(steps: Array, header: _Header) -> IntArray:
    """(K,) us from unsigned steps, which have to lead from t0 to t1."""
    # Cast before summing: a sum that casts on the way is many times slower.
    elapsed_us = np.cumsum(steps.astype(np.int64))
    duration_us = header.t1_us - header.t0_us
    if elapsed_us[0] != 0 or elapsed_us[-1] != duration_us:
        found = f"{elapsed_us[0]} and {elapsed_us[-1]} us"
        raise _malformed(f"a first step of 0 and a sum of {duration_us} us", found)
    return np.asarray(elapsed_us + header.t0_us)


def _has_padding(bits: Array, count: int) -> bool:
    """Whether a bit behind the last event is set."""
    return bool(count % 8 and bits[-1] >> count % 8)


def _polarity(bits: Array, count: int) -> Array:
    """(K,) int8, -1 or +1."""
    if _has_padding(bits, count):
        raise _malformed("polarity bits padded with 0", "a 1 behind the last event")
    signs = np.unpackbits(bits, count=count, bitorder="little").view(np.int8)
    return np.asarray(signs * np.int8(2) - np.int8(1))


def _check_crc(part: str, data: bytes | memoryview, expected: int) -> None:
    if zlib.crc32(data) != expected:
        raise EventsError(
            _SUBJECT,
            f"{part} bytes of CRC {expected:#010x}",
            f"{zlib.crc32(data):#010x}",
            reason="CHUNK_CRC_MISMATCH",
        )


def _decompressed(payload: memoryview, size: int) -> Array:
    """(size,) uint8; the frame has to declare just this size."""
    try:
        declared = zstandard.get_frame_parameters(payload).content_size
        if declared != size:
            raise _malformed(f"{size} bytes in the payload", f"{declared} declared")
        data = zstandard.ZstdDecompressor().decompress(payload, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise _malformed("one zstd frame", str(error)) from error
    return np.frombuffer(data, np.uint8)


def _malformed(expected: str, found: str) -> EventsError:
    return EventsError(_SUBJECT, expected, found, reason="CHUNK_MALFORMED")
