"""Recordings of events: HDF5, NPZ, RAW, DAT and text, told apart by their first bytes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from roel_service.io.event_columns import checked_streams
from roel_service.io.events_hdf5 import Hdf5Events, write_events_hdf5
from roel_service.io.events_npz import NpzEvents
from roel_service.io.events_prophesee import HEADER_MARK, PropheseeEvents
from roel_service.io.events_text import TextEvents
from roel_service.io.files import open_input
from roel_service.scene.events import EventStream, concatenate

__all__ = ["EventFile", "open_events", "read_events", "write_events_hdf5"]

_HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
_ZIP_MAGIC = b"PK\x03\x04"

Columns = Hdf5Events | NpzEvents | PropheseeEvents | TextEvents


@dataclass(frozen=True, kw_only=True)
class EventFile:
    """A recording on disk, an `EventSource`; it may be read more than once.

    Attributes:
        width, height: sensor size, px.
        columns: the file behind it.
    """

    width: int
    height: int
    columns: Columns

    @property
    def event_count(self) -> int | None:
        """Number of events, None where only reading the file would tell."""
        return self.columns.event_count

    @property
    def time_range_us(self) -> tuple[int, int] | None:
        """First and last time on the pose clock, None where only reading the file would tell."""
        return self.columns.time_range_us

    def chunks(self) -> Iterator[EventStream]:
        """Chunks of about a million events; the file is never in memory as a whole.

        Raises:
            EventsError: with the index of the event (or the number of the line) that is wrong.
        """
        return checked_streams(
            self.columns.blocks(),
            t_offset_us=self.columns.t_offset_us,
            width=self.width,
            height=self.height,
            subject=self.columns.subject,
        )


def open_events(path: Path, width: int, height: int, *, subject: str | None = None) -> EventFile:
    """Open a recording and check what can be known without reading it.

    Args:
        path: HDF5, NPZ, RAW (EVT2, EVT3), DAT or text file.
        width, height: sensor size, px.
        subject: name of the recording in errors; the path by default.

    Raises:
        InputError: no readable file.
        EventsError: no events, missing or unequal columns, damage, an unknown HDF5 filter or
            encoding.
    """
    subject = str(path) if subject is None else subject
    with open_input(path) as file:
        magic = file.read(len(_HDF5_MAGIC))
    columns: Columns
    if magic == _HDF5_MAGIC:
        columns = Hdf5Events.open(path, subject)
    elif magic.startswith(_ZIP_MAGIC):
        columns = NpzEvents.open(path, subject)
    elif magic.startswith(HEADER_MARK):
        columns = PropheseeEvents.open(path, subject)
    else:
        columns = TextEvents(path=path, subject=subject)
    return EventFile(width=width, height=height, columns=columns)


def read_events(path: Path, width: int, height: int) -> EventStream:
    """Read a whole recording into memory; raises as `open_events` and `EventFile.chunks`."""
    return concatenate(list(open_events(path, width, height).chunks()))
