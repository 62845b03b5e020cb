"""Events in HDF5: `events/{x,y,t,p}`, `ms_to_idx` and `t_offset`, as TUM-VIE, VECtor and DSEC do."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import h5py
import hdf5plugin
import numpy as np

from roel_service.arrays import Array, IntArray
from roel_service.errors import EventsError
from roel_service.io.event_columns import (
    CHUNK_EVENT_COUNT,
    ColumnBlocks,
    EventColumns,
    no_events,
)
from roel_service.io.files import whole_file
from roel_service.io.text import MAX_TIME_US
from roel_service.scene.events import EventStream

# What damaged metadata raises out of h5py, depending on where the damage is.
_DAMAGE = (OSError, RuntimeError, KeyError, ValueError, TypeError, OverflowError, MemoryError)

# A file that claims more than this for each stored byte is taken for damaged or hostile; event
# columns compress 2 to 10 times. Small files are free to be as uniform as they like.
_MAX_COMPRESSION_RATIO = 1000
_UNSUSPICIOUS_BYTES = 1 << 26

_STORED_CHUNK_EVENT_COUNT = 1 << 17
# 28 hours: what `ms_to_idx` may index; a longer recording has a wrong clock.
_MAX_INDEXED_MS = 10**8


@dataclass(frozen=True, kw_only=True)
class Hdf5Events:
    """The event columns of one HDF5 file.

    Attributes:
        path, subject: the file, and its name in errors.
        event_count: length of the columns.
        t_offset_us: what brings the times of the file on the pose clock.
        time_range_us: first and last time on the pose clock.
    """

    path: Path
    subject: str
    event_count: int
    t_offset_us: int
    time_range_us: tuple[int, int]

    @staticmethod
    def open(path: Path, subject: str) -> Hdf5Events:
        """Look at the columns without reading them.

        Raises:
            EventsError: NO_EVENTS, UNSUPPORTED_HDF5_FILTER, or anything else that is not four
                integer columns of one length, whole and inside the file.
        """
        with _datasets(path, subject) as (columns, t_offset_us):
            t = columns["t"]
            if len(t) == 0:
                raise no_events(subject)
            first_us, last_us = (int(t[index]) + t_offset_us for index in (0, -1))
            return Hdf5Events(
                path=path,
                subject=subject,
                event_count=len(t),
                t_offset_us=t_offset_us,
                time_range_us=(first_us, last_us),
            )

    def blocks(self) -> ColumnBlocks:
        """The columns front to back; a block holds whole stored chunks, so each is read once."""
        with _datasets(self.path, self.subject) as (columns, _):
            stored = max((column.chunks or (1,))[0] for column in columns.values())
            size = max(stored, CHUNK_EVENT_COUNT // stored * stored)
            for start in range(0, self.event_count, size):
                part = slice(start, start + size)
                yield EventColumns(
                    t_us=columns["t"][part],
                    x=columns["x"][part],
                    y=columns["y"][part],
                    p=columns["p"][part],
                )


@contextmanager
def _datasets(path: Path, subject: str) -> Iterator[tuple[dict[str, h5py.Dataset], int]]:
    """The four checked columns of an open file, and its time offset in us."""
    try:
        with h5py.File(path, "r") as file:
            columns = {name: _column(file, f"events/{name}", subject) for name in "txyp"}
            _check_sizes(columns, subject)
            yield columns, _t_offset_us(file, subject)
    except _DAMAGE as error:
        raise EventsError(subject, "an undamaged HDF5 file", _first_line(error)) from error


def _column(file: h5py.File, name: str, subject: str) -> h5py.Dataset:
    dataset = _local_object(file, name)
    if not isinstance(dataset, h5py.Dataset):
        raise EventsError(subject, f"a dataset {name}", "none in the file")
    if dataset.ndim != 1 or dataset.dtype.kind not in "iub":
        found = f"{dataset.ndim} of {dataset.dtype}"
        raise EventsError(subject, f"{name} with 1 dimension of integers", found)
    if dataset.is_virtual or dataset.external:
        raise EventsError(subject, f"{name} stored in the file itself", "a reference to another")
    filters = dataset.id.get_create_plist()
    for index in range(filters.get_nfilters()):
        code, _, _, label = filters.get_filter(index)
        if not h5py.h5z.filter_avail(code):
            raise EventsError(
                subject,
                f"{name} compressed by a known filter",
                f"filter {code} ({label.decode('ascii', 'replace')})",
                reason="UNSUPPORTED_HDF5_FILTER",
            )
    return dataset


def _local_object(file: h5py.File, name: str) -> object:
    """An object of the file; None when it is missing or only a link into another file."""
    node: h5py.Group | h5py.Dataset = file
    for part in name.split("/"):
        if not isinstance(node, h5py.Group) or part not in node:
            return None
        if not isinstance(node.get(part, getlink=True), h5py.HardLink):
            return None
        node = node[part]
    return node


def _check_sizes(columns: dict[str, h5py.Dataset], subject: str) -> None:
    lengths = {name: len(column) for name, column in columns.items()}
    if len(set(lengths.values())) != 1:
        raise EventsError(subject, "event columns of equal length", f"{lengths}")
    stored = sum(column.id.get_storage_size() for column in columns.values())
    claimed = sum(
        max(len(column), (column.chunks or (0,))[0]) * column.dtype.itemsize
        for column in columns.values()
    )
    if claimed > stored * _MAX_COMPRESSION_RATIO + _UNSUSPICIOUS_BYTES:
        expected = f"columns that {stored} stored bytes can hold"
        raise EventsError(subject, expected, f"a claim of {claimed} bytes")


def _t_offset_us(file: h5py.File, subject: str) -> int:
    if "t_offset" not in file:
        return 0
    dataset = _local_object(file, "t_offset")
    if isinstance(dataset, h5py.Dataset) and dataset.size == 1 and dataset.dtype.kind in "iu":
        t_offset_us = int(np.asarray(dataset[()]).item())
        if abs(t_offset_us) <= MAX_TIME_US:
            return t_offset_us
    expected = f"t_offset as one integer within {MAX_TIME_US} us"
    raise EventsError(subject, expected, f"{dataset}")


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


def write_events_hdf5(path: Path, chunks: Iterable[EventStream]) -> None:
    """Write a recording: four columns (blosc, zstd), `ms_to_idx` and `t_offset`.

    Times are stored relative to `t_offset`, the first event's millisecond, so that `ms_to_idx`
    starts with the recording: `ms_to_idx[k]` is the first event with t >= 1000 k.

    Raises:
        EventsError: NO_EVENTS, EVENT_TIME_NOT_MONOTONE across chunks, or more than 28 hours.
    """
    with whole_file(path) as temporary, h5py.File(temporary, "w") as file:
        writer = _ColumnWriter(file, str(path))
        for chunk in chunks:
            writer.append(chunk)
        writer.finish()


class _ColumnWriter:
    """Growing datasets of one file."""

    def __init__(self, file: h5py.File, subject: str) -> None:
        self._file = file
        self._subject = subject
        self._event_count = 0
        self._t_offset_us = 0
        self._last_us = 0
        self._columns = {
            name: self._growing(f"events/{name}", dtype)
            for name, dtype in (("x", "<u2"), ("y", "<u2"), ("t", "<i8"), ("p", "u1"))
        }
        self._ms_to_idx = self._growing("ms_to_idx", "<u8")

    def _growing(self, name: str, dtype: str) -> h5py.Dataset:
        return self._file.create_dataset(
            name,
            shape=(0,),
            maxshape=(None,),
            dtype=dtype,
            chunks=(_STORED_CHUNK_EVENT_COUNT,),
            compression=hdf5plugin.Blosc(cname="zstd", clevel=5, shuffle=hdf5plugin.Blosc.SHUFFLE),
        )

    def append(self, chunk: EventStream) -> None:
        if len(chunk) == 0:
            return
        if self._event_count == 0:
            self._t_offset_us = int(chunk.t_us[0]) // 1000 * 1000
        t = chunk.t_us - self._t_offset_us
        if t[0] < self._last_us:
            raise EventsError(
                self._subject,
                "chunks in the order of time",
                f"a decrease at event {self._event_count}",
                reason="EVENT_TIME_NOT_MONOTONE",
            )
        self._index(t)
        for name, values in (("x", chunk.x), ("y", chunk.y), ("t", t), ("p", chunk.polarity > 0)):
            _extend(self._columns[name], values)
        self._event_count += len(chunk)
        self._last_us = int(t[-1])

    def _index(self, t: IntArray) -> None:
        """Extend `ms_to_idx` by the milliseconds that begin up to the last of the times."""
        start, stop = len(self._ms_to_idx), int(t[-1]) // 1000 + 1
        if stop > _MAX_INDEXED_MS:
            raise EventsError(self._subject, f"at most {_MAX_INDEXED_MS} ms", f"{stop} ms")
        first = np.searchsorted(t, 1000 * np.arange(start, stop))
        _extend(self._ms_to_idx, first + self._event_count)

    def finish(self) -> None:
        if self._event_count == 0:
            raise no_events(self._subject)
        _extend(self._ms_to_idx, np.array([self._event_count]))
        self._file.create_dataset("t_offset", data=np.int64(self._t_offset_us))


def _extend(dataset: h5py.Dataset, values: Array) -> None:
    size = len(dataset)
    dataset.resize((size + len(values),))
    dataset[size:] = values
