"""Event columns, slices of them, and sources larger than memory."""

from __future__ import annotations

from collections.abc import Iterator
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
        part: EventStream = object.__new__(EventStream)
        # Not by the constructor, which would check again what is known: that costs an upload a tenth.
        for name in ("t_us", "x", "y", "polarity"):
            object.__setattr__(part, name, getattr(self, name)[start:stop])
        object.__setattr__(part, "width", self.width)
        object.__setattr__(part, "height", self.height)
        return part

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
    """One stream from chunks in the order of time; raises `EventsError` if they are not."""
    return EventStream(
        t_us=np.concatenate([chunk.t_us for chunk in chunks]),
        x=np.concatenate([chunk.x for chunk in chunks]),
        y=np.concatenate([chunk.y for chunk in chunks]),
        polarity=np.concatenate([chunk.polarity for chunk in chunks]),
        width=chunks[0].width,
        height=chunks[0].height,
    )


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
