"""Event chunks: up to 131,072 events as one independent block, the same on the wire and on disk.

Little-endian. A 48-byte header (magic `REC1`, sizes, first and last time, CRC-32 of payload and
header) precedes one zstd frame of byte planes: time steps, x, y, polarity bits.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import zstandard

from roel_service.arrays import Array, IntArray
from roel_service.errors import EventsError
from roel_service.scene.events import EventSource, EventStream, concatenate
from roel_service.wire.byte_planes import integers_from_planes, planes_from_integers

MAX_CHUNK_EVENT_COUNT = 131_072
# Longest time between neighbours in a chunk: what four bytes hold.
MAX_STEP_US = 2**32 - 1

_MAGIC = b"REC1"
_VERSION = 1
_COLUMNAR_ZSTD = 1
_ZSTD_LEVEL = 3
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


def split_chunks(source: EventSource) -> Iterator[EventStream]:
    """Cut a recording into streams that `encode_chunk` accepts.

    The cuts depend on the events alone, not on the chunks in which the source delivers them.
    """
    rest: EventStream | None = None
    for chunk in source.chunks():
        events = chunk if rest is None else concatenate([rest, chunk])
        jumps = np.flatnonzero(np.diff(events.t_us) > MAX_STEP_US) + 1
        start = 0
        for jump in jumps.tolist():
            yield from _pieces(events, start, jump)
            start = jump
        stop = start + (len(events) - start) // MAX_CHUNK_EVENT_COUNT * MAX_CHUNK_EVENT_COUNT
        yield from _pieces(events, start, stop)
        rest = _part(events, stop, len(events)) if stop < len(events) else None
    if rest is not None:
        yield rest


def _pieces(events: EventStream, start: int, stop: int) -> Iterator[EventStream]:
    for first in range(start, stop, MAX_CHUNK_EVENT_COUNT):
        yield _part(events, first, min(first + MAX_CHUNK_EVENT_COUNT, stop))


def _part(events: EventStream, start: int, stop: int) -> EventStream:
    return EventStream(
        t_us=events.t_us[start:stop],
        x=events.x[start:stop],
        y=events.y[start:stop],
        polarity=events.polarity[start:stop],
        width=events.width,
        height=events.height,
    )


def encode_chunk(events: EventStream) -> bytes:
    """Encode 1 to `MAX_CHUNK_EVENT_COUNT` events.

    Raises:
        EventsError: CHUNK_MALFORMED; another count, or a step above `MAX_STEP_US`.
    """
    count = len(events)
    if not 1 <= count <= MAX_CHUNK_EVENT_COUNT:
        raise _malformed(f"1 to {MAX_CHUNK_EVENT_COUNT} events", f"{count}")
    steps_us = np.diff(events.t_us, prepend=events.t_us[0])
    longest_us = int(steps_us.max())
    if longest_us > MAX_STEP_US:
        raise _malformed(f"steps of at most {MAX_STEP_US} us", f"{longest_us} us")
    width_bytes = 2 if longest_us < 2**16 else 4
    planes = (
        planes_from_integers(steps_us, width_bytes),
        planes_from_integers(events.x, 2),
        planes_from_integers(events.y, 2),
        np.packbits(events.polarity > 0, bitorder="little").tobytes(),
    )
    payload = zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compress(b"".join(planes))
    header = _HEADER.pack(
        *_Header(
            magic=_MAGIC,
            version=_VERSION,
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


def decode_chunk(data: bytes, *, previous_t1_us: int | None) -> EventStream:
    """Decode one chunk; nothing is allocated before the sizes are known to be true.

    Args:
        data: exactly one chunk.
        previous_t1_us: last time of the chunk before, None for the first.

    Raises:
        EventsError: UNSUPPORTED_ENCODING, CHUNK_CRC_MISMATCH, CHUNK_MALFORMED,
            EVENT_TIME_NOT_MONOTONE or EVENT_OUT_OF_BOUNDS.
    """
    header = _read_header(data)
    payload = data[_HEADER_BYTES:]
    if header.payload_length != len(payload):
        raise _malformed(f"a payload of {header.payload_length} bytes", f"{len(payload)}")
    _check_crc("payload", payload, header.payload_crc)
    if previous_t1_us is not None and header.t0_us < previous_t1_us:
        raise EventsError(
            _SUBJECT,
            f"times from {previous_t1_us} us, where the chunk before ends",
            f"{header.t0_us} us",
            reason="EVENT_TIME_NOT_MONOTONE",
        )
    width_bytes, count = header.width_bytes, header.event_count
    ends = np.cumsum([width_bytes * count, 2 * count, 2 * count, -(-count // 8)])
    planes = _decompressed(payload, int(ends[-1]))
    steps, x, y, signs = np.split(planes, ends[:-1])
    return EventStream(
        t_us=_times(integers_from_planes(steps, width_bytes), header),
        x=integers_from_planes(x, 2),
        y=integers_from_planes(y, 2),
        polarity=_polarity(signs, count),
        width=header.width,
        height=header.height,
    )


def _read_header(data: bytes) -> _Header:
    if len(data) < _HEADER_BYTES:
        raise _malformed(f"at least {_HEADER_BYTES} bytes", f"{len(data)}")
    header = _Header(*_HEADER.unpack_from(data))
    if header.magic != _MAGIC:
        raise _malformed(f"the magic {_MAGIC!r}", f"{header.magic!r}")
    _check_crc("header", data[: _HEADER.size], _CRC.unpack_from(data, _HEADER.size)[0])
    if (header.version, header.encoding) != (_VERSION, _COLUMNAR_ZSTD):
        expected = f"version {_VERSION}, encoding {_COLUMNAR_ZSTD}"
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


def _polarity(bits: Array, count: int) -> Array:
    """(K,) int8, -1 or +1."""
    if count % 8 and bits[-1] >> count % 8:
        raise _malformed("polarity bits padded with 0", "a 1 behind the last event")
    signs = np.unpackbits(bits, count=count, bitorder="little").view(np.int8)
    return np.asarray(signs * np.int8(2) - np.int8(1))


def _check_crc(part: str, data: bytes, expected: int) -> None:
    if zlib.crc32(data) != expected:
        raise EventsError(
            _SUBJECT,
            f"{part} bytes of CRC {expected:#010x}",
            f"{zlib.crc32(data):#010x}",
            reason="CHUNK_CRC_MISMATCH",
        )


def _decompressed(payload: bytes, size: int) -> Array:
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
