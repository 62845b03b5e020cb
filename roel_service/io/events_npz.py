"""Events in NPZ archives with the columns `x y t p`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from roel_service.errors import EventsError
from roel_service.io.event_columns import (
    CHUNK_EVENT_COUNT,
    ColumnBlocks,
    EventColumns,
    no_events,
)
from roel_service.io.npz import NpzMember, open_members

_NAMES = ("t", "x", "y", "p")


@dataclass(frozen=True, kw_only=True)
class NpzEvents:
    """The event columns of one archive.

    Attributes:
        path, subject: the file, and its name in errors.
        event_count: length of the columns.
    """

    path: Path
    subject: str
    event_count: int
    t_offset_us: int = 0

    @property
    def time_range_us(self) -> tuple[int, int]:
        """First and last time; reads the column of times."""
        with _columns(self.path, self.subject) as columns:
            first_us = last_us = int(columns["t"].read(1)[0])
            for start in range(1, self.event_count, CHUNK_EVENT_COUNT):
                times = columns["t"].read(min(CHUNK_EVENT_COUNT, self.event_count - start))
                last_us = int(times[-1])
        return first_us, last_us

    @staticmethod
    def open(path: Path, subject: str) -> NpzEvents:
        """Look at the columns without reading them.

        Raises:
            EventsError: NO_EVENTS, or anything else than four integer columns of one length.
        """
        with _columns(path, subject) as columns:
            event_count = columns["t"].shape[0]
        if event_count == 0:
            raise no_events(subject)
        return NpzEvents(path=path, subject=subject, event_count=event_count)

    def blocks(self) -> ColumnBlocks:
        """The columns front to back."""
        with _columns(self.path, self.subject) as columns:
            for start in range(0, self.event_count, CHUNK_EVENT_COUNT):
                count = min(CHUNK_EVENT_COUNT, self.event_count - start)
                yield EventColumns(
                    t_us=columns["t"].read(count),
                    x=columns["x"].read(count),
                    y=columns["y"].read(count),
                    p=columns["p"].read(count),
                )


@contextmanager
def _columns(path: Path, subject: str) -> Iterator[dict[str, NpzMember]]:
    with open_members(path, _NAMES, subject, EventsError) as members:
        for name in _NAMES:
            if name not in members:
                raise EventsError(subject, "arrays x y t p", f"no {name}")
            member = members[name]
            if len(member.shape) != 1 or member.dtype.kind not in "iub":
                found = f"{len(member.shape)} of {member.dtype}"
                raise EventsError(subject, f"{name} with 1 dimension of integers", found)
        lengths = {name: members[name].shape[0] for name in _NAMES}
        if len(set(lengths.values())) != 1:
            raise EventsError(subject, "event columns of equal length", f"{lengths}")
        yield members
