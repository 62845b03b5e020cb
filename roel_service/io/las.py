"""LAS, the exchange format of laser scans: positions alone; compressed ones (LAZ) by laspy, extra `laz`."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.errors import CloudError
from roel_service.io.files import open_input

MAGIC = b"LASF"
# Byte offsets of the public header: where points begin, their format, length and count (as of
# LAS 1.4 with 64 bits), and scale and offset of the three coordinates.
_BEGIN, _FORMAT, _COUNT_1_4, _SCALE = 96, 104, 247, 131
_HEADER_BYTES, _HEADER_BYTES_1_4 = 227, 375
# LAZ marks its compressed points by the upper bits of the format.
_COMPRESSED = 0xC0


def is_las(head: bytes) -> bool:
    """Whether a file that begins so is LAS or LAZ."""
    return head.startswith(MAGIC)


def read_las(path: Path) -> FloatArray:
    """(N, 3) points, in the frame of the file.

    Raises:
        InputError: no readable file.
        CloudError: shorter than its header claims, or compressed (LAZ) and damaged, or the extra `laz`
            is missing.
    """
    subject, expected = str(path), "a LAS file"
    with open_input(path) as file:
        data = file.read()
    if len(data) < _HEADER_BYTES:
        raise CloudError(subject, expected, f"{len(data)} bytes")
    if data[_FORMAT] & _COMPRESSED:
        return _unpacked(data, subject)
    (begin,) = struct.unpack_from("<I", data, _BEGIN)
    row_bytes, count = struct.unpack_from("<HI", data, _FORMAT + 1)
    if count == 0 and len(data) >= _HEADER_BYTES_1_4:
        (count,) = struct.unpack_from("<Q", data, _COUNT_1_4)
    if row_bytes < 12 or begin + count * row_bytes > len(data):
        raise CloudError(subject, expected, f"{count} points in {len(data)} bytes")
    scale, offset = np.array(struct.unpack_from("<6d", data, _SCALE)).reshape(2, 3)
    row = np.dtype({"names": ["xyz"], "formats": ["<3i4"], "itemsize": row_bytes})
    steps = np.frombuffer(data, row, count, begin)["xyz"].astype(np.float64)
    return np.asarray(steps * scale + offset)


def _unpacked(data: bytes, subject: str) -> FloatArray:
    """(N, 3) points of a compressed file."""
    try:
        import laspy
    except ModuleNotFoundError as missing:
        expected = "roel-service[laz] installed, to read compressed points (LAZ)"
        raise CloudError(subject, expected, f"no {missing.name}") from missing
    try:
        cloud = laspy.read(io.BytesIO(data))
    except (laspy.LaspyException, ValueError, EOFError, OSError, RuntimeError) as damage:
        raise CloudError(subject, "a LAZ file", str(damage)[:200]) from damage
    return np.asarray(cloud.xyz, dtype=np.float64)
