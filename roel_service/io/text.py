"""Tables of numbers as text: whitespace between columns, `#` starts a comment."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from typing import BinaryIO

import numpy as np

from roel_service.arrays import FloatArray, IntArray
from roel_service.errors import InputError

BLOCK_BYTES = 1 << 24

# Largest time in either direction, 68 years: float64 seconds below 2^31 still tell apart single
# microseconds, also after the multiplication by 1e6.
MAX_TIME_US = 2**31 * 10**6

# A line that begins with anything printable but a comment.
_DATA = re.compile(rb"^[^\S\n]*[!\"$-~]", re.MULTILINE)


def line_blocks(
    file: BinaryIO, subject: str, error: type[InputError], block_bytes: int = BLOCK_BYTES
) -> Iterator[tuple[int, bytes]]:
    """Read a file as blocks of whole lines.

    Yields:
        The number of the block's first line, from 1, and the block.

    Raises:
        InputError: of type `error`; a line longer than a block.
    """
    line, rest = 1, b""
    while data := file.read(block_bytes):
        end = data.rfind(b"\n") + 1
        if end == 0 and len(rest) + len(data) > block_bytes:
            raise error(subject, f"lines below {block_bytes} bytes", f"a longer line {line}")
        if end:
            block = rest + data[:end]
            yield line, block
            line += block.count(b"\n")
            rest = b""
        rest += data[end:]
    if rest:
        yield line, rest


def parse_rows(
    block: bytes, columns: str, first_line: int, subject: str, error: type[InputError]
) -> FloatArray:
    """Numbers of a block of lines.

    Args:
        block: whole lines.
        columns: names of the expected columns, separated by spaces; for their count and the error.
        first_line: number of the block's first line.
        subject: the file, for the error.
        error: type of the error.

    Returns:
        (N, C) finite values, one row for each line that holds more than a comment.

    Raises:
        InputError: of type `error`, with the number of the first line that is no such row.
    """
    count = len(columns.split())
    cause = "none"
    if _DATA.search(block):
        try:
            rows = np.loadtxt(io.BytesIO(block), ndmin=2)
            if rows.shape[1] == count and np.isfinite(rows).all():
                return np.asarray(rows, dtype=np.float64)
        except ValueError as failure:
            cause = str(failure)
    elif next(_data_lines(block, first_line), None) is None:
        return np.empty((0, count))
    for line, fields in _data_lines(block, first_line):
        if len(fields) != count or not all(_is_finite_number(field) for field in fields):
            found = b" ".join(fields)[:80].decode("ascii", "replace")
            raise error(subject, f"finite numbers {columns}", f"{found!r} in line {line}")
    raise error(subject, f"lines of {columns}", cause)


def line_of_row(block: bytes, row: int, first_line: int) -> int:
    """Number of the line that became a row of `parse_rows`."""
    for index, (line, _) in enumerate(_data_lines(block, first_line)):
        if index == row:
            return line
    raise IndexError(row)


def us_from_seconds(seconds: FloatArray) -> IntArray:
    """(N,) nearest int64 microseconds; exact for 6 decimals below `MAX_TIME_US`."""
    return np.rint(seconds * 1e6).astype(np.int64)


def _data_lines(block: bytes, first_line: int) -> Iterator[tuple[int, list[bytes]]]:
    for line, text in enumerate(block.split(b"\n"), first_line):
        if fields := text.partition(b"#")[0].split():
            yield line, fields


def _is_finite_number(field: bytes) -> bool:
    try:
        return bool(np.isfinite(float(field)))
    except ValueError:
        return False
