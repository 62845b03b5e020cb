"""PLY, ascii and binary: vertices with normals, faces with one number of corners."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from roel_service.arrays import Array, FloatArray, IntArray
from roel_service.errors import InputError
from roel_service.io.files import open_input

_END_OF_HEADER = b"end_header"
_MAX_HEADER_BYTES = 1 << 16

# numpy's codes of PLY's type names, old and new.
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}


@dataclass(frozen=True, eq=False, kw_only=True)
class Ply:
    """What this project reads of a PLY file.

    Attributes:
        vertices: (N, 3).
        normals: (N, 3) or None.
        faces: (F, 3) indices of vertices, larger faces cut into fans; None without faces.
    """

    vertices: FloatArray
    normals: FloatArray | None
    faces: IntArray | None


@dataclass(frozen=True, kw_only=True)
class _Property:
    name: str
    type: str
    # Type of the length that precedes a list; None for a single value.
    length_type: str | None = None


@dataclass(frozen=True, kw_only=True)
class _Element:
    name: str
    count: int
    properties: tuple[_Property, ...] = ()


# The columns of one element by property; lists have two axes.
_Table = dict[str, Array]


def read_ply(path: Path, error: type[InputError]) -> Ply:
    """Read vertices, normals and faces.

    Raises:
        InputError: no readable file; of type `error` when it is no PLY file, holds fewer bytes
            than its header claims, or has faces that differ in their number of corners.
    """
    subject = str(path)
    with open_input(path) as file:
        data = file.read()
    try:
        tables = _tables(data)
        vertex = tables["vertex"]
        vertices = np.column_stack([vertex[axis] for axis in ("x", "y", "z")])
    except (ValueError, KeyError) as damage:
        raise error(subject, "a PLY file with vertices x y z", f"{damage}") from damage
    normals = None
    if {"nx", "ny", "nz"} <= vertex.keys():
        normals = np.column_stack([vertex[axis] for axis in ("nx", "ny", "nz")])
    faces = _faces(tables.get("face", {}))
    if faces is not None and faces.size and not 0 <= faces.min() <= faces.max() < len(vertices):
        raise error(subject, f"faces of vertices 0 to {len(vertices) - 1}", "another index")
    return Ply(vertices=vertices, normals=normals, faces=faces)


def read_ply_edges(
    path: Path, error: type[InputError], subject: str
) -> tuple[FloatArray, dict[str, Array]]:
    """Edges between vertices, as segments (E, 2, 3), and the other columns of the edges.

    Raises:
        InputError: of type `error`, as `read_ply`; no edges, or edges of other vertices.
    """
    with open_input(path) as file:
        data = file.read()
    try:
        tables = _tables(data)
        vertices = np.column_stack([tables["vertex"][axis] for axis in ("x", "y", "z")])
        edge = tables["edge"]
        ends = np.column_stack([edge["vertex1"], edge["vertex2"]]).astype(np.int64)
    except (ValueError, KeyError) as damage:
        expected = "a PLY file with vertices x y z and edges vertex1 vertex2"
        raise error(subject, expected, f"{damage}") from damage
    if ends.size and not 0 <= ends.min() <= ends.max() < len(vertices):
        raise error(subject, f"edges of vertices 0 to {len(vertices) - 1}", "another index")
    return vertices[ends].astype(np.float64), edge


def _faces(face: _Table) -> IntArray | None:
    """(F, 3) triangles: polygons become fans about their first corner."""
    corners = face.get("vertex_indices", face.get("vertex_index"))
    if corners is None or corners.ndim != 2 or corners.shape[1] < 3:
        return None
    corners = corners.astype(np.int64)
    fans = [corners[:, [0, second, second + 1]] for second in range(1, corners.shape[1] - 1)]
    return np.concatenate(fans)


def _tables(data: bytes) -> dict[str, _Table]:
    """The columns of all elements; raises ValueError where the bytes are not as claimed."""
    byte_order, elements, body = _header(data)
    if not byte_order:
        return _ascii_tables(data[body:], elements)
    tables: dict[str, _Table] = {}
    for element in elements:
        tables[element.name], size = _binary_table(memoryview(data)[body:], element, byte_order)
        body += size
    return tables


def _header(data: bytes) -> tuple[str, list[_Element], int]:
    """Byte order (empty for text), elements in order, and where the body starts."""
    end = data.find(_END_OF_HEADER, 0, _MAX_HEADER_BYTES)
    body = data.find(b"\n", end) + 1
    if not data.startswith(b"ply") or end < 0 or body == 0:
        raise ValueError("no header")
    byte_order: str | None = None
    elements: list[_Element] = []
    for line in data[:end].decode("ascii", "replace").splitlines():
        match line.split():
            case ["format", name, _] if name in _BYTE_ORDERS:
                byte_order = _BYTE_ORDERS[name]
            case ["element", name, count] if count.isdecimal() and len(count) < 19:
                elements.append(_Element(name=name, count=int(count)))
            case ["property", "list", length_type, item_type, name] if elements:
                column = _Property(
                    name=name, type=_TYPES[item_type], length_type=_TYPES[length_type]
                )
                elements[-1] = _with_property(elements[-1], column)
            case ["property", item_type, name] if elements:
                column = _Property(name=name, type=_TYPES[item_type])
                elements[-1] = _with_property(elements[-1], column)
            case ["ply"] | ["comment", *_] | ["obj_info", *_] | []:
                pass
            case _:
                raise ValueError(f"the header line {line[:80]!r}")
    if byte_order is None:
        raise ValueError("no format")
    return byte_order, elements, body


def _with_property(element: _Element, column: _Property) -> _Element:
    return replace(element, properties=(*element.properties, column))


def _binary_table(data: memoryview, element: _Element, byte_order: str) -> tuple[_Table, int]:
    """The columns of an element at the start of the data, and its size in bytes."""
    if element.count == 0:
        return {}, 0
    row = _row_type(data, element, byte_order)
    size = element.count * row.itemsize
    if size > len(data):
        raise ValueError(f"{element.count} x {element.name} in {len(data)} bytes")
    rows = np.frombuffer(data, row, element.count) if row.itemsize else np.empty(0, row)
    for column in element.properties:
        if column.length_type is not None:
            lengths = rows[f"length of {column.name}"]
            if (lengths != lengths[0]).any():
                raise ValueError(f"lists {column.name} of different lengths")
    return {column.name: rows[column.name] for column in element.properties}, size


def _row_type(data: memoryview, element: _Element, byte_order: str) -> np.dtype[np.void]:
    """Type of a row, provided that all rows have lists as long as the first row's."""
    fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
    for column in element.properties:
        item = byte_order + column.type
        if column.length_type is None:
            fields.append((column.name, item))
            continue
        fields.append((f"length of {column.name}", byte_order + column.length_type))
        before = np.dtype(fields).itemsize
        length_bytes = np.dtype(column.length_type).itemsize
        if len(data) < before:
            raise ValueError(f"a list {column.name} in {len(data)} bytes")
        length = np.frombuffer(data[before - length_bytes : before], fields[-1][1])[0]
        if not 0 <= length * np.dtype(item).itemsize <= len(data):
            raise ValueError(f"a list {column.name} of {length} in {len(data)} bytes")
        fields.append((column.name, item, (int(length),)))
    return np.dtype(fields)


def _ascii_tables(body: bytes, elements: list[_Element]) -> dict[str, _Table]:
    lines = [line for line in body.split(b"\n") if line.strip()]
    tables: dict[str, _Table] = {}
    for element in elements:
        own, lines = lines[: element.count], lines[element.count :]
        if len(own) < element.count:
            raise ValueError(f"{len(own)} of {element.count} lines {element.name}")
        tables[element.name] = _ascii_table(own, element) if own else {}
    return tables


def _ascii_table(lines: list[bytes], element: _Element) -> _Table:
    rows = np.array(b" ".join(lines).split(), dtype=np.float64).reshape(len(lines), -1)
    table: _Table = {}
    position = 0
    for column in element.properties:
        if column.length_type is None:
            table[column.name] = rows[:, position]
            position += 1
            continue
        lengths = rows[:, position]
        if (lengths != lengths[0]).any() or not 0 <= lengths[0] < rows.shape[1]:
            raise ValueError(f"lists {column.name} of different lengths")
        start, position = position + 1, position + 1 + int(lengths[0])
        table[column.name] = rows[:, start:position]
    if position != rows.shape[1]:
        raise ValueError(f"{rows.shape[1]} values a line of {element.name}")
    return table
