"""PCD, the format of the Point Cloud Library: ascii, binary and compressed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from roel_service.arrays import Array
from roel_service.errors import CloudError
from roel_service.io.files import open_input

_MAX_HEADER_BYTES = 1 << 16
_ENTRIES = (
    "VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA",
)  # fmt: skip
_TYPES = {
    "F4": "<f4", "F8": "<f8", "I1": "<i1", "I2": "<i2", "I4": "<i4", "I8": "<i8",
    "U1": "<u1", "U2": "<u2", "U4": "<u4", "U8": "<u8",
}  # fmt: skip
# Three bytes of LZF stand for 264 at most; who claims more lies.
_MAX_LZF_RATIO = 88


@dataclass(frozen=True, kw_only=True)
class _Field:
    name: str
    type: str
    count: int


@dataclass(frozen=True, kw_only=True)
class _Header:
    """What the body holds: points of these fields, written as ascii, binary or binary_compressed."""

    fields: tuple[_Field, ...]
    point_count: int
    encoding: str

    @property
    def row_type(self) -> np.dtype[np.void]:
        """Type of a point; fields by position, because padding repeats the name `_`."""
        return np.dtype(
            [(f"{i}", field.type, (field.count,)) for i, field in enumerate(self.fields)]
        )

    def positions(self, *names: str) -> list[int] | None:
        """Where these fields are; None unless all are there once and of one value each."""
        found = [
            [i for i, f in enumerate(self.fields) if (f.name, f.count) == (name, 1)]
            for name in names
        ]
        return [places[0] for places in found] if all(len(p) == 1 for p in found) else None


def read_pcd(path: Path) -> tuple[Array, Array | None]:
    """(N, 3) points and (N, 3) normals or None; values that are not finite are kept.

    Raises:
        InputError: no readable file.
        CloudError: no PCD file with fields x y z, or one shorter than its header claims.
    """
    with open_input(path) as file:
        data = file.read()
    try:
        header, begin = _header(data)
        place = header.positions("x", "y", "z")
        if place is None:
            raise ValueError("no fields x y z")
        columns = _columns(header, data[begin:])
    except ValueError as damage:
        raise CloudError(str(path), "a PCD file with fields x y z", str(damage)) from damage
    normal = header.positions("normal_x", "normal_y", "normal_z")
    points = np.column_stack([columns[i] for i in place])
    return points, None if normal is None else np.column_stack([columns[i] for i in normal])


def _header(data: bytes) -> tuple[_Header, int]:
    """The header, and where the body starts."""
    begin, entries = 0, dict[str, list[str]]()
    while "DATA" not in entries:
        end = data.find(b"\n", begin, _MAX_HEADER_BYTES)
        if end < 0:
            raise ValueError("no header")
        line = data[begin:end].decode("ascii", "replace")
        begin = end + 1
        key, *values = line.split() or [""]
        if key in _ENTRIES:
            entries[key] = values
        elif line.strip() and not line.startswith("#"):
            raise ValueError(f"the header line {line[:80]!r}")
    return _parsed(entries), begin


def _parsed(entries: dict[str, list[str]]) -> _Header:
    names = entries.get("FIELDS", [])
    counts = _whole_numbers(entries.get("COUNT", ["1"] * len(names)))
    types = [
        kind + size
        for kind, size in zip(entries.get("TYPE", []), entries.get("SIZE", []), strict=False)
    ]
    shape = _whole_numbers(entries.get("WIDTH", []) + entries.get("HEIGHT", ["1"]))
    points = _whole_numbers(entries.get("POINTS", [])) or [math.prod(shape)]
    if not len(names) == len(types) == len(counts) or not set(types) <= set(_TYPES):
        raise ValueError("fields without a type that PCD knows")
    if max(counts, default=0) > 1 << 16:
        raise ValueError(f"a field of {max(counts)} values")
    if entries["DATA"] not in (["ascii"], ["binary"], ["binary_compressed"]):
        raise ValueError(f"DATA {' '.join(entries['DATA'])[:40]}")
    fields = zip(names, types, counts, strict=True)
    return _Header(
        fields=tuple(_Field(name=n, type=_TYPES[t], count=c) for n, t, c in fields),
        point_count=points[0],
        encoding=entries["DATA"][0],
    )


def _whole_numbers(words: list[str]) -> list[int]:
    if not all(word.isdecimal() and len(word) < 13 for word in words):
        raise ValueError(f"numbers {' '.join(words)[:80]!r} in the header")
    return [int(word) for word in words]


def _columns(header: _Header, body: bytes) -> list[Array]:
    """(N,) or (N, C) values of each field."""
    if header.encoding == "ascii":
        return _ascii_columns(header, body)
    if header.encoding == "binary":
        rows = np.frombuffer(_exactly(body, header), header.row_type, header.point_count)
        return [rows[name][:, 0] for name in header.row_type.names or ()]
    return _compressed_columns(header, body)


def _exactly(data: bytes, header: _Header) -> bytes:
    size = header.point_count * header.row_type.itemsize
    if size > len(data):
        raise ValueError(f"{header.point_count} points in {len(data)} bytes")
    return data[:size]


def _ascii_columns(header: _Header, body: bytes) -> list[Array]:
    width = sum(field.count for field in header.fields)
    values = np.array(body.split(), dtype=np.float64)
    if values.size != width * header.point_count:
        raise ValueError(f"{values.size} values for {header.point_count} points of {width}")
    table = values.reshape(header.point_count, width)
    first = np.cumsum([0, *(field.count for field in header.fields)])
    return [table[:, i] for i in first[:-1]]


def _compressed_columns(header: _Header, body: bytes) -> list[Array]:
    """Field after field, each with all its values, as one LZF block after its two sizes."""
    packed_bytes, raw_bytes = np.frombuffer(body[:8], "<u4") if len(body) >= 8 else (0, 0)
    packed = body[8 : 8 + int(packed_bytes)]
    if len(packed) != packed_bytes or raw_bytes > _MAX_LZF_RATIO * packed_bytes:
        raise ValueError(f"{raw_bytes} bytes packed in {len(packed)}")
    raw = _exactly(unpack_lzf(packed, int(raw_bytes)), header)
    columns, begin = [], 0
    for field in header.fields:
        size = field.count * header.point_count
        columns.append(np.frombuffer(raw, field.type, size, begin)[:: max(field.count, 1)])
        begin += size * np.dtype(field.type).itemsize
    return columns


def unpack_lzf(packed: bytes, size: int) -> bytes:
    """LZF: literals of up to 32 bytes, and copies of up to 264 bytes from at most 8 KiB before.

    Open3D unpacks it too, but takes the sizes that a header claims for granted.

    Raises:
        ValueError: damaged, or not of this size.
    """
    out, at = bytearray(), 0
    try:
        while at < len(packed) and len(out) <= size:
            control = packed[at]
            at += 1
            if control < 32:
                out += packed[at : at + control + 1]
                at += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += packed[at]
                at += 1
            start = len(out) - ((control & 31) << 8 | packed[at]) - 1
            at += 1
            if start < 0:
                raise ValueError("a copy from before the data")
            _copy(out, start, length + 2)
    except IndexError as damage:
        raise ValueError("LZF data that end too early") from damage
    if len(out) != size:
        raise ValueError(f"{len(out)} of {size} bytes of LZF data")
    return bytes(out)


def _copy(out: bytearray, start: int, length: int) -> None:
    """Append bytes that are there already; a copy that reaches its own end repeats itself."""
    piece = out[start : start + length]
    repeats = -(-length // len(piece))
    out += (piece * repeats)[:length]
