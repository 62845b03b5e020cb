"""Event columns, slices of them, and sources larger than memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from roel_service.arrays import Array, FloatArray, IntArray, frozen_array
from roel_service.errors import EventsError


@dataclass(frozen=True, eq=False, kw_only=True)
class EventSlice:
    """Consecutive events as views of their columns, with a reference time.

    Attributes:
        t_us: (K,) int64, non-decreasing.
        x, y: (K,) uint16, px.
        polarity: (K,) int8, -1 or +1.
        t_ref_us: time that counts as zero in `xyt`.
    """

    t_us: IntArray
    x: Array
    y: Array
    polarity: Array
    t_ref_us: int

    def __len__(self) -> int:
        return len(self.t_us)

    def first(self, count: int) -> EventSlice:
        """At most so many events from the start, without a copy."""
        return EventSlice(
            t_us=self.t_us[:count],
            x=self.x[:count],
            y=self.y[:count],
            polarity=self.polarity[:count],
            t_ref_us=self.t_ref_us,
        )

    def xyt(self, time_scale_px_per_ms: float) -> FloatArray:
        """(K, 3) space-time points in px; the only place where time becomes a float."""
        t_ms = (self.t_us - self.t_ref_us) * 1e-3
        return np.column_stack([self.x, self.y, t_ms * time_scale_px_per_ms]).astype(np.float64)


@dataclass(frozen=True, eq=False, kw_only=True)
class EventStream:
    """Events of one sensor as columns, in the order of their time.

    Attributes:
        t_us: (K,) int64, non-decreasing, on the clock of the poses.
        x, y: (K,) uint16, px, inside the sensor.
        polarity: (K,) int8, -1 or +1.
        width, height: sensor size, px.

    Raises:
        EventsError: EVENT_TIME_NOT_MONOTONE, EVENT_OUT_OF_BOUNDS or EVENT_POLARITY_INVALID.
    """

    t_us: IntArray
    x: Array
    y: Array
    polarity: Array
    width: int
    height: int

    def __post_init__(self) -> None:
        count = len(self.t_us)
        for name, dtype in (("t_us", np.int64), ("x", np.uint16), ("y", np.uint16)):
            column = frozen_array(getattr(self, name), dtype, (count,), name)
            object.__setattr__(self, name, column)
        polarity = frozen_array(self.polarity, np.int8, (count,), "polarity")
        object.__setattr__(self, "polarity", polarity)
        if count:
            self._check()

    def _check(self) -> None:
        late = self.t_us[1:] < self.t_us[:-1]
        if late.any():
            raise time_not_monotone(int(np.argmax(late)) + 1, "events")
        for name, size in (("x", self.width), ("y", self.height)):
            column = getattr(self, name)
            if int(column.max()) >= size:
                index = int(np.argmax(column >= size))
                raise out_of_bounds(name, size, int(column[index]), index, "events")
        if not (np.abs(self.polarity) == 1).all():
            index = int(np.argmax(np.abs(self.polarity) != 1))
            raise EventsError(
                "events",
                "polarity -1 or +1",
                f"{self.polarity[index]} at event {index}",
                reason="EVENT_POLARITY_INVALID",
            )

    def __len__(self) -> int:
        return len(self.t_us)

    @property
    def time_range_us(self) -> tuple[int, int] | None:
        """Times of the first and the last event; None for a stream without events."""
        return (int(self.t_us[0]), int(self.t_us[-1])) if len(self) else None

    def chunks(self) -> Iterator[EventStream]:
        """A stream in memory is its own only chunk (see `EventSource`)."""
        yield self

    def part(self, start: int, stop: int) -> EventStream:
        """Events start <= index < stop as a stream, without a copy."""
        columns = [column[start:stop] for column in self._columns()]
        return _known(columns, self.width, self.height)

    def _columns(self) -> tuple[IntArray, Array, Array, Array]:
        return self.t_us, self.x, self.y, self.polarity

    def slice(self, start: int, stop: int, t_ref_us: int) -> EventSlice:
        """Events start <= index < stop, without a copy."""
        return EventSlice(
            t_us=self.t_us[start:stop],
            x=self.x[start:stop],
            y=self.y[start:stop],
            polarity=self.polarity[start:stop],
            t_ref_us=t_ref_us,
        )

    def between(self, start_us: int, stop_us: int, t_ref_us: int | None = None) -> EventSlice:
        """Events start_us <= t < stop_us, without a copy."""
        start, stop = np.searchsorted(self.t_us, [start_us, stop_us])
        return self.slice(int(start), int(stop), start_us if t_ref_us is None else t_ref_us)

    def around(self, t_us: int, half_window_us: int) -> EventSlice:
        """Events t_us - half <= t < t_us + half, without a copy."""
        return self.between(t_us - half_window_us, t_us + half_window_us, t_us)

    def last(self, count: int, before_us: int) -> EventSlice:
        """The last `count` events before a time, without a copy; fewer at the start."""
        stop = int(np.searchsorted(self.t_us, before_us))
        return self.slice(max(0, stop - count), stop, before_us)


class EventSource(Protocol):
    """A recording that is read once, front to back, in chunks that fit in memory."""

    @property
    def width(self) -> int: ...

    @property
    def height(self) -> int: ...

    @property
    def time_range_us(self) -> tuple[int, int] | None:
        """Times of the first and the last event; None while they are not known."""
        ...

    def chunks(self) -> Iterator[EventStream]:
        """Chunks in the order of time, each not before the end of the one before."""
        ...


def concatenate(chunks: list[EventStream]) -> EventStream:
    """One stream from chunks of one sensor in the order of time.

    Raises:
        EventsError: EVENT_TIME_NOT_MONOTONE for a chunk that begins before the one before it ends,
            SENSOR_MISMATCH for one of another size.
    """
    width, height = chunks[0].width, chunks[0].height
    index, last_us = 0, -(1 << 63)
    for chunk in chunks:
        if (chunk.width, chunk.height) != (width, height):
            expected, found = f"a sensor of {width}x{height}", f"{chunk.width}x{chunk.height}"
            raise EventsError("events", expected, found, reason="SENSOR_MISMATCH")
        if len(chunk) and chunk.t_us[0] < last_us:
            raise time_not_monotone(index, "events")
        index, last_us = index + len(chunk), chunk.t_us[-1] if len(chunk) else last_us
    columns = [np.concatenate(parts) for parts in zip(*(c._columns() for c in chunks), strict=True)]
    for column in columns:
        column.flags.writeable = False
    return _known(columns, width, height)


def _known(columns: Sequence[Array], width: int, height: int) -> EventStream:
    """A stream of columns that are known to be right.

    Not by the constructor, which would check again what is known: that costs an upload a tenth.
    """
    stream: EventStream = object.__new__(EventStream)
    for name, column in zip(("t_us", "x", "y", "polarity"), columns, strict=True):
        object.__setattr__(stream, name, column)
    object.__setattr__(stream, "width", width)
    object.__setattr__(stream, "height", height)
    return stream


def time_not_monotone(index: int, subject: str) -> EventsError:
    """The error for an event that is older than the one before it."""
    return EventsError(
        subject,
        "times that never decrease",
        f"a decrease at event {index}",
        reason="EVENT_TIME_NOT_MONOTONE",
    )


def out_of_bounds(column: str, size: int, value: int, index: int, subject: str) -> EventsError:
    """The error for an event outside the sensor."""
    return EventsError(
        subject,
        f"{column} in [0, {size})",
        f"{column} = {value} at event {index}",
        reason="EVENT_OUT_OF_BOUNDS",
    )
