"""Events as text, `t x y p` a line.

Times are seconds when the first block of lines shows a decimal point or an exponent in its first
column, and microseconds when all of that column is written as integers.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from roel_service.arrays import Array, FloatArray, IntArray
from roel_service.errors import EventsError
from roel_service.io.event_columns import ColumnBlocks, EventColumns
from roel_service.io.files import open_input
from roel_service.io.text import (
    MAX_TIME_US,
    line_blocks,
    line_of_row,
    parse_rows,
    us_from_seconds,
)

# Holds the last event line, unless kilobytes of comments follow it.
_TAIL_BYTES = 4096
# The time of a line of four numbers.
_FIRST_COLUMN = re.compile(
    rb"^[^\S\n]*([-+]?\d[\d.eE+-]*)(?=(?:[^\S\n]+[-+\d.eE]+){3}[^\S\n]*$)", re.MULTILINE
)
_SECONDS = re.compile(rb"^[^\S\n]*[-+]?\d*[.eE]", re.MULTILINE)
# Integers up to here are exact in the float64 of the parser; all columns stay far below.
_MAX_INTEGER = MAX_TIME_US


@dataclass(frozen=True, kw_only=True)
class TextEvents:
    """The event lines of one file.

    Attributes:
        path, subject: the file, and its name in errors.
    """

    path: Path
    subject: str
    t_offset_us: int = 0
    # Known once the file is read.
    event_count: None = None

    @property
    def time_range_us(self) -> tuple[int, int] | None:
        """First and last time, from both ends of the file; None where they are not well formed."""
        with open_input(self.path) as file:
            _, head = next(line_blocks(file, self.subject, EventsError), (1, b""))
            file.seek(max(0, file.seek(0, os.SEEK_END) - _TAIL_BYTES))
            tail = file.read()
        times = _FIRST_COLUMN.findall(head)[:1] + _FIRST_COLUMN.findall(tail)[-1:]
        if len(times) < 2:
            return None
        first_us, last_us = _times(np.array(times, dtype=np.float64), _is_seconds(head)).tolist()
        return first_us, last_us

    def blocks(self) -> ColumnBlocks:
        """The events front to back, about 16 MB of text at a time.

        Raises:
            EventsError: a line that is not four finite numbers, the last three integers.
        """
        is_seconds: bool | None = None
        with open_input(self.path) as file:
            for line, block in line_blocks(file, self.subject, EventsError):
                rows = parse_rows(block, "t x y p", line, self.subject, EventsError)
                if len(rows) == 0:
                    continue
                if is_seconds is None:
                    is_seconds = _is_seconds(block)
                yield self._columns(rows, is_seconds, block, line)

    def _columns(self, rows: FloatArray, is_seconds: bool, block: bytes, line: int) -> EventColumns:
        integers = rows[:, 1:] if is_seconds else rows
        odd = ((integers != np.rint(integers)) | (np.abs(integers) > _MAX_INTEGER)).any(axis=1)
        if is_seconds:
            odd |= np.abs(rows[:, 0]) > MAX_TIME_US / 1e6
        if odd.any():
            row = int(np.argmax(odd))
            unit = "seconds" if is_seconds else "integer microseconds"
            raise EventsError(
                self.subject,
                f"t in {unit} within {MAX_TIME_US} us, x, y and p as integers",
                f"{rows[row].tolist()} in line {line_of_row(block, row, line)}",
            )
        x, y, p = (column.astype(np.int64) for column in rows[:, 1:].T)
        return EventColumns(t_us=_times(rows[:, 0], is_seconds), x=x, y=y, p=p)


def _is_seconds(first_block: bytes) -> bool:
    return _SECONDS.search(first_block) is not None


def _times(values: Array, is_seconds: bool) -> IntArray:
    return us_from_seconds(values) if is_seconds else values.astype(np.int64)
