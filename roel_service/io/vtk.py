"""VTK's legacy format: the points of any data set, ascii or binary."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from roel_service.arrays import Array
from roel_service.errors import CloudError
from roel_service.io.files import open_input

MAGIC = b"# vtk DataFile"
# Binary numbers are big-endian.
_TYPES = {b"float": ">f4", b"double": ">f8"}
_POINTS = re.compile(rb"^POINTS[ \t]+(\d{1,18})[ \t]+(float|double)[ \t]*\r?\n", re.MULTILINE)
# The header ends with the points, whose line follows that of the data set and at most a few more.
_MAX_HEADER_BYTES = 4096
# A digit and a space are the least that a number takes as text.
_MIN_TEXT_BYTES = 2


def is_vtk(head: bytes) -> bool:
    """Whether a file that begins so is one of VTK's legacy format."""
    return head.startswith(MAGIC)


def read_vtk(path: Path) -> Array:
    """(N, 3) points; values that are not finite are kept.

    Raises:
        InputError: no readable file.
        CloudError: no points of floating-point numbers, or fewer than the header claims.
    """
    with open_input(path) as file:
        data = file.read()
    try:
        return _points(data)
    except ValueError as damage:
        raise CloudError(str(path), "a legacy VTK file with POINTS", str(damage)) from damage


def _points(data: bytes) -> Array:
    lines = data[:_MAX_HEADER_BYTES].split(b"\n", 3)
    encoding = lines[2].strip() if len(lines) > 3 else b""
    if encoding not in (b"ASCII", b"BINARY"):
        raise ValueError(f"the encoding {encoding[:40].decode('ascii', 'replace')!r}")
    header = _POINTS.search(data[:_MAX_HEADER_BYTES])
    if header is None:
        raise ValueError("no POINTS of float or double")
    count, body, kind = int(header[1]), data[header.end() :], np.dtype(_TYPES[header[2]])
    is_binary = encoding == b"BINARY"
    value_bytes = kind.itemsize if is_binary else _MIN_TEXT_BYTES
    # The last number may end the file.
    if 3 * count * value_bytes > len(body) + (not is_binary):
        raise ValueError(f"{count} points in {len(body)} bytes")
    if is_binary:
        return np.frombuffer(body, kind, 3 * count).reshape(-1, 3).astype(np.float64)
    # The numbers end where the next section begins, with a word.
    end = re.search(rb"\n\s*[A-Z]", body)
    values = body[: end.start() if end else None].split()
    if len(values) < 3 * count:
        raise ValueError(f"{len(values)} coordinates, not {3 * count}")
    return np.array(values[: 3 * count], np.float64).reshape(-1, 3)
