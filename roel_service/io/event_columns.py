"""Event columns as a file holds them, and the checks that make them an `EventStream`."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from roel_service.arrays import Array, BoolArray
from roel_service.errors import EventsError
from roel_service.io.text import MAX_TIME_US
from roel_service.scene.events import EventStream, out_of_bounds, time_not_monotone

# Events in a chunk: large enough that Python's share of the work vanishes, 13 MB as columns.
CHUNK_EVENT_COUNT = 1 << 20


@dataclass(frozen=True, eq=False, kw_only=True)
class EventColumns:
    """Consecutive events, unchecked.

    Attributes:
        t_us: (K,) integers on the clock of the file.
        x, y: (K,) integers, px.
        p: (K,) integers or booleans.
    """

    t_us: Array
    x: Array
    y: Array
    p: Array

    def __len__(self) -> int:
        return len(self.t_us)

    def pieces(self, size: int = CHUNK_EVENT_COUNT) -> Iterator[EventColumns]:
        """The same events in pieces of at most `size`, as views."""
        for start in range(0, len(self), size):
            part = slice(start, start + size)
            yield EventColumns(t_us=self.t_us[part], x=self.x[part], y=self.y[part], p=self.p[part])


# A recording as it is read, front to back; closing it closes the file.
ColumnBlocks = Generator[EventColumns, None, None]


def checked_streams(
    blocks: ColumnBlocks, *, t_offset_us: int, width: int, height: int, subject: str
) -> Iterator[EventStream]:
    """Check consecutive columns, across their borders too, and bring them on the pose clock.

    Args:
        blocks: the columns of one recording, front to back.
        t_offset_us: added to every time.
        width, height: sensor size, px.
        subject: the file, for the errors.

    Raises:
        EventsError: NO_EVENTS, EVENT_TIME_NOT_MONOTONE, EVENT_OUT_OF_BOUNDS,
            EVENT_POLARITY_INVALID, or times beyond `MAX_TIME_US`. Indices count from the start of
            the recording.
    """
    first = 0
    previous_us = -MAX_TIME_US
    negative: int | None = None
    # Closed here: an error would keep the file open for as long as its traceback lives.
    with closing(blocks):
        for columns in (piece for block in blocks for piece in block.pieces()):
            t_us = columns.t_us.astype(np.int64)
            _check_times(t_us, previous_us, first, subject)
            _check_bounds("x", columns.x, width, first, subject)
            _check_bounds("y", columns.y, height, first, subject)
            negative = _negative_value(columns.p) if negative is None else negative
            yield EventStream(
                t_us=t_us + t_offset_us if t_offset_us else t_us,
                x=columns.x.astype(np.uint16),
                y=columns.y.astype(np.uint16),
                polarity=_signs(columns.p, negative, first, subject),
                width=width,
                height=height,
            )
            first += len(columns)
            previous_us = int(t_us[-1])
    if first == 0:
        raise no_events(subject)


def no_events(subject: str) -> EventsError:
    """The error for a recording in which nothing happens."""
    return EventsError(subject, "at least one event", "none", reason="NO_EVENTS")


def _check_times(t_us: Array, previous_us: int, first: int, subject: str) -> None:
    late = t_us[1:] < t_us[:-1]
    for value in (int(t_us[0]), int(t_us[-1])):
        if abs(value) > MAX_TIME_US:
            raise EventsError(subject, f"times within {MAX_TIME_US} us", f"{value} us")
    if t_us[0] < previous_us:
        raise time_not_monotone(first, subject)
    if late.any():
        raise time_not_monotone(first + int(np.argmax(late)) + 1, subject)


def _check_bounds(name: str, column: Array, size: int, first: int, subject: str) -> None:
    if int(column.min()) < 0 or int(column.max()) >= size:
        index = int(np.argmax((column < 0) | (column >= size)))
        raise out_of_bounds(name, size, int(column[index]), first + index, subject)


def _negative_value(p: Array) -> int | None:
    """How the recording writes a negative event, told by the first; None while there is none."""
    negative = p != 1
    return int(p[np.argmax(negative)]) if negative.any() else None


def _signs(p: Array, negative: int | None, first: int, subject: str) -> Array:
    positive: BoolArray = p == 1
    valid = positive | (p == negative) if negative in (0, -1) else positive
    if not valid.all():
        index = int(np.argmin(valid))
        raise EventsError(
            subject,
            "polarity 0 or 1, or -1 or 1, throughout",
            f"{int(p[index])} at event {first + index}",
            reason="EVENT_POLARITY_INVALID",
        )
    return positive.view(np.int8) * np.int8(2) - np.int8(1)
