"""The line map container `.rlm`: preamble, header, blocks of lines, index, trailer.

Little-endian. Ends are rounded to steps (1 mm for rooms) and stored as columns of byte planes in
blocks of lines that are neighbours on a Morton curve. The last 32 bytes are the SHA-256 of all
others. Equal maps with equal provenance give equal bytes, in whatever order their lines come.
"""

from __future__ import annotations

import hashlib
import math
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import NamedTuple

import numpy as np
import zstandard
from google.protobuf.message import DecodeError

from roel_service.arrays import FloatArray
from roel_service.errors import MapFileError
from roel_service.scene.lines import LineMap
from roel_service.v1 import map_file_pb2
from roel_service.wire.line_columns import (
    COLUMN_BYTES,
    GEOMETRY_COLUMNS,
    MAX_STEPS,
    DamageError,
    Grid,
    RoundedLines,
    columns_from_lines,
    line_map_from_rounded,
    lines_from_columns,
    round_lines,
)
from roel_service.wire.nouns import bounds_from_proto, bounds_to_proto
from roel_service.wire.provenance import Provenance

RLM_MAGIC = b"RLM1"
FORMAT_MAJOR = 1
FORMAT_MINOR = 0
MAX_LINE_COUNT = 10**7
BLOCK_LINE_COUNT = 4096

_RAW, _ZSTD = 0, 1
_ZSTD_LEVEL = 19

_PREAMBLE = struct.Struct("<4sHHII")
_BLOCK = struct.Struct("<4sIIHH3i3i")
_COLUMN = struct.Struct("<BBHIII")
_INDEX = struct.Struct("<4sI")
_INDEX_ENTRY = struct.Struct("<QII6i32s")
_TRAILER = struct.Struct("<QII4s")
_SHA256_BYTES = 32


@dataclass(frozen=True, eq=False, kw_only=True)
class MapFile:
    """A decoded container.

    Attributes:
        line_map: lines in the order of the file.
        provenance: what the map was made of.
        frame_id: name of the frame of the coordinates.
        bounds_min_m, bounds_max_m: (3,) box around the lines before rounding.
        step_m: of the grid that coordinates were rounded to; they are off by at most half of it.
        dropped_line_count: lines left out because their ends fell on one step.
        format_version: major and minor.
        byte_count: size of the file.
        digest: `sha256:` and the hexadecimal digest of all its bytes.
    """

    line_map: LineMap
    provenance: Provenance
    frame_id: str
    bounds_min_m: FloatArray
    bounds_max_m: FloatArray
    step_m: float
    dropped_line_count: int
    format_version: tuple[int, int]
    byte_count: int
    digest: str


class _IndexEntry(NamedTuple):
    """Where a block lies and what it holds: the fields of `_INDEX_ENTRY`."""

    offset: int
    length: int
    line_count: int
    box: tuple[int, ...]
    sha256: bytes


def file_digest(data: bytes) -> str:
    """The name of a map file: `sha256:` and the hexadecimal digest of all its bytes."""
    return f"sha256:{hashlib.sha256(data).hexdigest()}"


def encode_map(line_map: LineMap, provenance: Provenance, *, frame_id: str = "world") -> bytes:
    """Encode a map; its lines take the order of the Morton codes of their starts.

    Lines whose ends fall on one step are left out and counted in the header.

    Args:
        line_map: at most `MAX_LINE_COUNT` lines.
        provenance: what the map was made of.
        frame_id: name of the frame of the coordinates.

    Raises:
        MapFileError: too many lines, or an extent beyond float64.
    """
    if len(line_map) > MAX_LINE_COUNT:
        raise MapFileError("map", f"at most {MAX_LINE_COUNT} lines", f"{len(line_map)}")
    points = line_map.segments.reshape(-1, 3) if len(line_map) else np.zeros((1, 3))
    lower, upper = points.min(axis=0), points.max(axis=0)
    grid = Grid.around(lower, upper)
    lines = round_lines(line_map, grid)
    header = map_file_pb2.MapHeader(
        frame_id=frame_id,
        step=grid.step,
        origin=grid.origin.tolist(),
        bounds=bounds_to_proto(lower, upper),
        line_count=len(lines),
        dropped_line_count=len(line_map) - len(lines),
        column_ids=list(COLUMN_BYTES),
        provenance=map_file_pb2.MapProvenance(**asdict(provenance)),
    ).SerializeToString(deterministic=True)
    preamble = _PREAMBLE.pack(
        RLM_MAGIC, FORMAT_MAJOR, FORMAT_MINOR, len(header), zlib.crc32(header)
    )
    data = bytearray(preamble + header)
    entries = []
    for first in range(0, len(lines), BLOCK_LINE_COUNT):
        part = lines[first : first + BLOCK_LINE_COUNT]
        block = _encode_block(part)
        digest = hashlib.sha256(block).digest()
        entries.append(_INDEX_ENTRY.pack(len(data), len(block), len(part), *_box(part), digest))
        data += block
    index = _INDEX.pack(b"IDX1", len(entries)) + b"".join(entries)
    trailer = _TRAILER.pack(len(data), len(index), len(lines), b"RLME")
    data += index + trailer
    return bytes(data + hashlib.sha256(data).digest())


def decode_map(data: bytes, *, subject: str = "map file") -> MapFile:
    """Decode a container; nothing is allocated before the sizes are known to be true.

    Args:
        data: the whole file.
        subject: its name, for errors.

    Raises:
        MapFileError: any byte changed, missing or added, or a format of another major version.
    """
    with _naming(subject):
        opened = _open(data)
        header = opened.header
        lower, upper = bounds_from_proto(header.bounds)
        blocks = [opened.rounded_lines(entry) for entry in opened.entries]
        return MapFile(
            line_map=line_map_from_rounded(_joined(blocks), opened.grid),
            provenance=_provenance(header.provenance),
            frame_id=header.frame_id,
            bounds_min_m=lower,
            bounds_max_m=upper,
            step_m=opened.grid.step,
            dropped_line_count=header.dropped_line_count,
            format_version=opened.format_version,
            byte_count=len(data),
            digest=file_digest(data),
        )


class MapBlocks:
    """A container whose blocks are decoded when somebody asks for them.

    Args:
        data: the whole file; its checksum is verified at once.
        subject: its name, for errors.

    Attributes:
        count: blocks.
        head, tail: the bytes before and behind all blocks.

    Raises:
        MapFileError: as `decode_map`, here or when the damaged block is decoded.
    """

    def __init__(self, data: bytes, *, subject: str = "map file") -> None:
        self._subject = subject
        with _naming(subject):
            self._opened = _open(data)
        self.count = len(self._opened.entries)
        index_offset = _TRAILER.unpack_from(data, len(data) - _SHA256_BYTES - _TRAILER.size)[0]
        first = self._opened.entries[0].offset if self.count else index_offset
        self.head = data[:first]
        self.tail = data[index_offset:]

    def sha256(self, block: int) -> bytes:
        """Digest of a block's bytes."""
        return self._opened.entries[block].sha256

    def stored(self, block: int) -> bytes:
        """The bytes of a block."""
        return self._opened.stored(self._opened.entries[block])

    def lines(self, block: int) -> LineMap:
        """The lines of a block."""
        with _naming(self._subject):
            rounded = self._opened.rounded_lines(self._opened.entries[block])
        return line_map_from_rounded(rounded, self._opened.grid)

    def bounds_m(self, block: int) -> tuple[FloatArray, FloatArray]:
        """(3,) corners of the box around a block's lines."""
        lower, upper = np.array(self._opened.entries[block].box).reshape(2, 3)
        return self._opened.grid.points(lower), self._opened.grid.points(upper)


@contextmanager
def _naming(subject: str) -> Iterator[None]:
    """Says which file is damaged."""
    try:
        yield
    except DamageError as damage:
        raise MapFileError(subject, "an undamaged line map", str(damage)) from damage


def _require(condition: bool, otherwise: str) -> None:
    if not condition:
        raise DamageError(otherwise)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Opened:
    """A container with its checksum and index verified.

    Attributes:
        content: all bytes but the checksum.
    """

    content: bytes
    header: map_file_pb2.MapHeader
    grid: Grid
    entries: list[_IndexEntry]
    format_version: tuple[int, int]

    def stored(self, entry: _IndexEntry) -> bytes:
        return self.content[entry.offset : entry.offset + entry.length]

    def rounded_lines(self, entry: _IndexEntry) -> RoundedLines:
        return _decode_block(self.stored(entry), entry, tuple(self.header.column_ids))


def _open(data: bytes) -> _Opened:
    smallest = _PREAMBLE.size + _INDEX.size + _TRAILER.size + _SHA256_BYTES
    _require(len(data) >= smallest, f"{len(data)} bytes")
    magic, major, minor, header_length, header_crc = _PREAMBLE.unpack_from(data)
    _require(magic == RLM_MAGIC, f"the magic {magic!r}")
    content, checksum = data[:-_SHA256_BYTES], data[-_SHA256_BYTES:]
    _require(hashlib.sha256(content).digest() == checksum, "another checksum")
    _require(major == FORMAT_MAJOR, f"format version {major}")
    header_bytes = content[_PREAMBLE.size : _PREAMBLE.size + header_length]
    _require(zlib.crc32(header_bytes) == header_crc, "another header checksum")
    header = _parse_header(header_bytes)
    return _Opened(
        content=content,
        header=header,
        grid=_grid(header),
        entries=_read_index(content, _PREAMBLE.size + header_length, header.line_count),
        format_version=(major, minor),
    )


def _parse_header(data: bytes) -> map_file_pb2.MapHeader:
    try:
        header = map_file_pb2.MapHeader.FromString(data)
    except DecodeError as error:
        raise DamageError("a header that is none") from error
    _require(header.line_count <= MAX_LINE_COUNT, f"a claim of {header.line_count} lines")
    ids = list(header.column_ids)
    _require(len(set(ids)) == len(ids) < 256, "columns that repeat")
    _require(set(GEOMETRY_COLUMNS) <= set(ids), "no geometry")
    return header


def _grid(header: map_file_pb2.MapHeader) -> Grid:
    step, origin = header.step, list(header.origin)
    _require(len(origin) == 3 and all(map(math.isfinite, origin)), "no origin")
    # Half the largest float leaves room for the origin.
    largest = 0.5 * float(np.finfo(np.float64).max)
    _require(0 < step <= largest / MAX_STEPS, f"a step of {step}")
    _require(max(map(abs, origin)) <= largest, "an origin too far away")
    return Grid(origin=np.array(origin), step=step)


def _provenance(message: map_file_pb2.MapProvenance) -> Provenance:
    return Provenance(
        config_digest=message.config_digest,
        code_version=message.code_version,
        events_sha256=message.events_sha256,
        poses_sha256=message.poses_sha256,
        camera_sha256=message.camera_sha256,
    )


def _read_index(content: bytes, blocks_offset: int, line_count: int) -> list[_IndexEntry]:
    """The entries of all blocks, which fill the bytes between header and index."""
    trailer_offset = len(content) - _TRAILER.size
    offset, length, total, magic = _TRAILER.unpack_from(content, trailer_offset)
    _require(magic == b"RLME", f"the trailer magic {magic!r}")
    _require(offset + length == trailer_offset and length >= _INDEX.size, "no index")
    magic, count = _INDEX.unpack_from(content, offset)
    _require(magic == b"IDX1", f"the index magic {magic!r}")
    _require(length == _INDEX.size + count * _INDEX_ENTRY.size, f"a claim of {count} blocks")
    entries = []
    for position in range(offset + _INDEX.size, trailer_offset, _INDEX_ENTRY.size):
        start, size, lines, *box, sha256 = _INDEX_ENTRY.unpack_from(content, position)
        _require(start == blocks_offset, "blocks that do not adjoin")
        _require(1 <= lines <= BLOCK_LINE_COUNT, f"a block of {lines} lines")
        entries.append(_IndexEntry(start, size, lines, tuple(box), sha256))
        blocks_offset += size
    _require(blocks_offset == offset, "bytes between blocks and index")
    _require(total == line_count, f"{total} lines in the trailer")
    _require(sum(entry.line_count for entry in entries) == total, "blocks of other lines")
    return entries


def _encode_block(lines: RoundedLines) -> bytes:
    columns = columns_from_lines(lines)
    stored = {column: _compressed(raw) for column, raw in columns.items()}
    directory = b"".join(
        _COLUMN.pack(column, codec, 0, len(columns[column]), len(data), zlib.crc32(data))
        for column, (codec, data) in stored.items()
    )
    body = directory + b"".join(data for _, data in stored.values())
    length = _BLOCK.size + len(body)
    return _BLOCK.pack(b"BLK1", length, len(lines), len(columns), 0, *_box(lines)) + body


def _decode_block(block: bytes, entry: _IndexEntry, column_ids: tuple[int, ...]) -> RoundedLines:
    _require(hashlib.sha256(block).digest() == entry.sha256, "another block checksum")
    _require(len(block) >= _BLOCK.size, f"a block of {len(block)} bytes")
    magic, length, count, column_count, reserved, *box = _BLOCK.unpack_from(block)
    _require(magic == b"BLK1" and reserved == 0, "no block")
    _require((length, count) == (entry.length, entry.line_count), "a block of another size")
    _require(column_count == len(column_ids), f"{column_count} columns")
    columns = {}
    for column, data in _stored_columns(block, count, column_ids):
        if column in COLUMN_BYTES:
            columns[column] = data
    lines = lines_from_columns(columns, count)
    _require(tuple(box) == entry.box == _box(lines), "another box")
    return lines


def _stored_columns(
    block: bytes, count: int, column_ids: tuple[int, ...]
) -> Iterator[tuple[int, bytes]]:
    """Raw bytes of each column; those of unknown columns stay as they are stored."""
    position = _BLOCK.size + len(column_ids) * _COLUMN.size
    for index, expected in enumerate(column_ids):
        _require(len(block) >= position, "a directory that ends too early")
        entry = _COLUMN.unpack_from(block, _BLOCK.size + index * _COLUMN.size)
        column, codec, reserved, raw_length, stored_length, crc = entry
        data = block[position : position + stored_length]
        _require(column == expected and reserved == 0, f"column {column}")
        _require(codec in (_RAW, _ZSTD), f"codec {codec}")
        _require(len(data) == stored_length and zlib.crc32(data) == crc, f"damage in {column}")
        if column in COLUMN_BYTES:
            _require(raw_length == count * COLUMN_BYTES[column], f"{raw_length} bytes raw")
            data = _decompressed(data, raw_length) if codec == _ZSTD else data
            _require(len(data) == raw_length, f"{len(data)} bytes raw")
        yield column, data
        position += stored_length
    _require(position == len(block), "bytes behind the columns")


def _joined(blocks: list[RoundedLines]) -> RoundedLines:
    empty = RoundedLines(
        start=np.empty((0, 3), np.int64),
        end=np.empty((0, 3), np.int64),
        observation_count=np.empty(0, np.uint16),
        rms_code=np.empty(0, np.uint8),
        sigma_code=np.empty(0, np.uint8),
    )
    blocks = [empty, *blocks]
    return RoundedLines(
        start=np.concatenate([block.start for block in blocks]),
        end=np.concatenate([block.end for block in blocks]),
        observation_count=np.concatenate([block.observation_count for block in blocks]),
        rms_code=np.concatenate([block.rms_code for block in blocks]),
        sigma_code=np.concatenate([block.sigma_code for block in blocks]),
    )


def _box(lines: RoundedLines) -> tuple[int, ...]:
    """Smallest and largest steps of all ends: x y z, x y z."""
    lower = np.minimum(lines.start, lines.end).min(axis=0)
    upper = np.maximum(lines.start, lines.end).max(axis=0)
    return (*lower.tolist(), *upper.tolist())


def _compressed(raw: bytes) -> tuple[int, bytes]:
    """Codec and bytes, whichever is shorter."""
    packed = zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compress(raw)
    return (_ZSTD, packed) if len(packed) < len(raw) else (_RAW, raw)


def _decompressed(data: bytes, size: int) -> bytes:
    """The one frame that declares just this size."""
    try:
        _require(zstandard.get_frame_parameters(data).content_size == size, "another raw size")
        return zstandard.ZstdDecompressor().decompress(data, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise DamageError(str(error)) from error
