"""Recordings as Prophesee's cameras write them: EVT2 and EVT3 (RAW) and DAT.

All begin with header lines `% key value`. EVT2 and EVT3 are streams of words that depend on those
before them: the upper bits of the time come in words of their own and wrap around, and so do row and
first column of the vectors of EVT3. Each block of a file is decoded as a whole, behind words that
tell what holds at its begin.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from roel_service.arrays import Array, IntArray
from roel_service.errors import EventsError
from roel_service.io.event_columns import ColumnBlocks, EventColumns, no_events
from roel_service.io.files import open_input

HEADER_MARK = b"% "

_MAX_HEADER_LINES = 1000
_MAX_LINE_BYTES = 4096
# Of a file, decoded at a time; at most some twelve events for each two bytes.
_BLOCK_BYTES = 1 << 18

# Types of words.
_EVT2_OFF, _EVT2_ON, _EVT2_TIME_HIGH = 0x0, 0x1, 0x8
_EVT3_Y, _EVT3_X, _EVT3_BASE, _EVT3_VECTOR_12, _EVT3_VECTOR_8 = 0x0, 0x2, 0x3, 0x4, 0x5
_EVT3_TIME_LOW, _EVT3_TIME_HIGH = 0x6, 0x8

# Bits of a time that are not in the word of an event, and of those that come with it.
_EVT2_HIGH_BITS, _EVT2_LOW_BITS = 28, 6
_EVT3_HIGH_BITS, _EVT3_LOW_BITS = 12, 12
_DAT_BITS = 32

# Kind and size of the records of a DAT file with changes of brightness, of older and newer cameras.
_DAT_KINDS = (b"\x00\x08", b"\x0c\x08")


@dataclass(frozen=True, kw_only=True)
class PropheseeEvents:
    """The events of one file.

    Attributes:
        path, subject: the file, and its name in errors.
        encoding: `evt2`, `evt3` or `dat`.
        data_offset: where the words begin.
    """

    path: Path
    subject: str
    encoding: str
    data_offset: int
    t_offset_us: int = 0
    # Known once the file is read.
    event_count: None = None

    @staticmethod
    def open(path: Path, subject: str) -> PropheseeEvents:
        """Read the header.

        Raises:
            EventsError: another format, or a file that ends within a word.
        """
        with open_input(path) as file:
            header = _header(file, subject)
            encoding = _encoding(header, file, subject)
            data_offset = file.tell()
            size_bytes = file.seek(0, 2) - data_offset
        if size_bytes == 0:
            raise no_events(subject)
        word_bytes = _DECODERS[encoding].word_bytes
        if size_bytes % word_bytes:
            expected = f"{encoding.upper()} words of {word_bytes} bytes"
            found = f"{size_bytes % word_bytes} bytes at the end"
            raise EventsError(subject, expected, found)
        return PropheseeEvents(
            path=path, subject=subject, encoding=encoding, data_offset=data_offset
        )

    @property
    def time_range_us(self) -> tuple[int, int] | None:
        """First and last time; reads the file. None for one without events."""
        times = [(int(block.t_us[0]), int(block.t_us[-1])) for block in self.blocks()]
        return (times[0][0], times[-1][1]) if times else None

    def blocks(self) -> ColumnBlocks:
        """The events front to back."""
        format_ = _DECODERS[self.encoding]
        clock = _Clock(format_.time_bits)
        held = np.empty(0, format_.word)
        with open_input(self.path) as file:
            file.seek(self.data_offset)
            while data := file.read(_BLOCK_BYTES):
                words = np.concatenate([held, np.frombuffer(data, format_.word)])
                columns, held = format_.decode(words, clock)
                if len(columns):
                    yield columns


class _Clock:
    """Makes times of a counter that wraps around.

    Args:
        bits: of the counter.
    """

    def __init__(self, bits: int) -> None:
        self._period = 1 << bits
        self._last = 0

    def unwrapped(self, counts: Array) -> IntArray:
        """(K,) counts that never wrap, from those that come next in the file."""
        counts = counts.astype(np.int64)
        steps = np.diff(counts, prepend=self._last % self._period)
        # A fall by more than half of the range is a new turn; a smaller one is disorder.
        turns = np.cumsum(steps < -self._period // 2) + self._last // self._period
        unwrapped = counts + turns * self._period
        if len(unwrapped):
            self._last = int(unwrapped[-1])
        return np.asarray(unwrapped)


def _decoded_dat(words: Array, clock: _Clock) -> tuple[EventColumns, Array]:
    """Records of a time and a place, which need nothing of those before them."""
    place = words["place"]
    columns = EventColumns(
        t_us=clock.unwrapped(words["t_us"]),
        x=(place & 0x3FFF).astype(np.int64),
        y=(place >> 14 & 0x3FFF).astype(np.int64),
        p=(place >> 28).astype(np.int64),
    )
    return columns, words[:0]


def _decoded_evt2(words: Array, clock: _Clock) -> tuple[EventColumns, Array]:
    """Events with the lowest bits of their time, behind words with the others."""
    kind = words >> 28
    is_high = kind == _EVT2_TIME_HIGH
    high, last_high = _latest(is_high)
    is_event = ((kind == _EVT2_OFF) | (kind == _EVT2_ON)) & (high >= 0)
    times = np.zeros(len(words), np.int64)
    times[is_high] = clock.unwrapped(words[is_high] & (1 << _EVT2_HIGH_BITS) - 1)
    events = words[is_event]
    low = events >> 22 & (1 << _EVT2_LOW_BITS) - 1
    columns = EventColumns(
        t_us=times[high[is_event]] << _EVT2_LOW_BITS | low,
        x=(events >> 11 & 0x7FF).astype(np.int64),
        y=(events & 0x7FF).astype(np.int64),
        p=kind[is_event].astype(np.int64),
    )
    return columns, words[last_high]


def _decoded_evt3(words: Array, clock: _Clock) -> tuple[EventColumns, Array]:
    """Single events and vectors of them, behind words with time, row and first column."""
    kind, value = words >> 12, (words & 0xFFF).astype(np.int64)
    is_high = kind == _EVT3_TIME_HIGH
    high, _ = _latest(is_high)
    begun, last_begun = _changed(is_high, value)
    low, last_low = _latest(kind == _EVT3_TIME_LOW)
    row, last_row = _latest(kind == _EVT3_Y)
    base, last_base = _latest(kind == _EVT3_BASE)

    is_vector = (kind == _EVT3_VECTOR_12) | (kind == _EVT3_VECTOR_8)
    sizes = np.where(kind == _EVT3_VECTOR_12, 12, 8) * is_vector
    covered = np.cumsum(sizes) - sizes

    is_known = (high >= 0) & (row >= 0)
    event = np.flatnonzero(is_known & ((kind == _EVT3_X) | is_vector & (base >= 0)))
    single = kind[event] == _EVT3_X
    # Of a vector each bit is an event; a single one is the first bit of a vector of its own.
    masks = np.where(single, 1, value[event] & np.where(kind[event] == _EVT3_VECTOR_8, 0xFF, 0xFFF))
    which, bit = np.nonzero(masks[:, None] >> np.arange(12) & 1)

    word, single = event[which], single[which]
    first = np.where(single, word, base[word])
    start = (value[first] & 0x7FF) + np.where(single, 0, covered[word] - covered[first])
    times = np.zeros(len(words), np.int64)
    times[is_high] = clock.unwrapped(value[is_high]) << _EVT3_LOW_BITS
    # The lower bits begin anew with the upper ones, if those have changed.
    has_low = low[word] > begun[word]
    columns = EventColumns(
        t_us=times[high[word]] + np.where(has_low, value[low[word]], 0),
        x=start + bit,
        y=value[row[word]] & 0x7FF,
        p=value[first] >> 11,
    )
    return columns, _held_evt3(words, (last_begun, last_low, last_row), last_base, covered, sizes)


def _held_evt3(
    words: Array, last: tuple[Array, ...], last_base: Array, covered: IntArray, sizes: IntArray
) -> Array:
    """What the next block begins with: the last word of each kind, in their order."""
    held = np.sort(np.concatenate([*last, last_base]))
    kept = words[held]
    if len(last_base):
        # The base has moved on by the vectors behind it; beyond the sensor it stays there.
        (index,) = last_base
        moved = int(words[index] & 0x7FF) + int(covered[-1] + sizes[-1] - covered[index])
        kept[held == index] = words[index] & 0xF800 | min(moved, 0x7FF)
    return np.asarray(kept)


def _latest(is_kind: Array) -> tuple[IntArray, IntArray]:
    """(K,) index of the last such word up to each, -1 before the first; and of the last of all."""
    index = np.flatnonzero(is_kind)
    counts = np.cumsum(is_kind)
    return np.concatenate([[-1], index])[counts], index[-1:]


def _changed(is_high: Array, value: IntArray) -> tuple[IntArray, IntArray]:
    """`_latest` of the words that gave the upper bits of the time another value."""
    index = np.flatnonzero(is_high)
    is_new = np.zeros(len(is_high), bool)
    is_new[index] = np.diff(value[index], prepend=-1) != 0
    return _latest(is_new)


@dataclass(frozen=True, kw_only=True)
class _Format:
    """One encoding: its words, what they mean, and the bits of its counter of time."""

    word: np.dtype[np.generic]
    time_bits: int
    decode: Callable[[Array, _Clock], tuple[EventColumns, Array]]

    @property
    def word_bytes(self) -> int:
        return self.word.itemsize


_DECODERS = {
    "evt2": _Format(word=np.dtype("<u4"), time_bits=_EVT2_HIGH_BITS, decode=_decoded_evt2),
    "evt3": _Format(word=np.dtype("<u2"), time_bits=_EVT3_HIGH_BITS, decode=_decoded_evt3),
    "dat": _Format(
        word=np.dtype([("t_us", "<u4"), ("place", "<u4")]), time_bits=_DAT_BITS, decode=_decoded_dat
    ),
}

# How headers call them, in lower case.
_ENCODINGS = {"2.0": "evt2", "3.0": "evt3", "evt2": "evt2", "evt3": "evt3"}


def _header(file: BinaryIO, subject: str) -> dict[str, str]:
    """Keys and values; leaves the file behind the header."""
    header: dict[str, str] = {}
    for _ in range(_MAX_HEADER_LINES):
        start = file.tell()
        line = file.readline(_MAX_LINE_BYTES)
        if not line.startswith(HEADER_MARK) or not line.endswith(b"\n"):
            file.seek(start)
            return header
        key, _, value = line[len(HEADER_MARK) :].decode("latin-1").strip().partition(" ")
        if key == "end":
            return header
        header[key.lower()] = value.strip()
    raise EventsError(subject, f"at most {_MAX_HEADER_LINES} lines of header", "more")


def _encoding(header: dict[str, str], file: BinaryIO, subject: str) -> str:
    """How the words are to be read; leaves the file at the first one."""
    told = header.get("format", "").partition(";")[0] or header.get("evt", "")
    if told:
        encoding = _ENCODINGS.get(told.lower())
        if encoding is None:
            raise EventsError(subject, "a RAW file in EVT2 or EVT3", f"{told[:40]!r}")
        return encoding
    kind = file.read(2)
    if kind not in _DAT_KINDS:
        expected = "a header with `% evt 2.0`, `% evt 3.0` or `% format`, or a DAT file"
        raise EventsError(subject, expected, f"records of kind {kind.hex()!r}")
    return "dat"
