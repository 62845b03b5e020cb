"""Readers of recordings that only the benchmark knows: AEDAT 2.0 and the DVS128 `.mat` files.

A DAVIS240 counts columns from the right and rows from below; its events come out with pixel (0, 0)
in the top-left corner. The `.mat` files are taken as they are.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from roel_service.arrays import Array, IntArray
from roel_service.errors import EventsError
from roel_service.io.files import open_input, read_input
from roel_service.scene.events import EventStream

# Recordings of the benchmark are a few megabytes; a longer file is not one of them.
MAX_BYTES = 256 << 20

# DAVIS240 addresses in AEDAT 2.0: [31] frame or IMU sample, [30:22] row, [21:12] column,
# [11] polarity, [10] external trigger (jAER's `DavisChip`).
DAVIS_WIDTH, DAVIS_HEIGHT = 240, 180
ADDRESS_IS_NO_EVENT = (1 << 31) | (1 << 10)
DVS128_SIZE = 128


def read_aedat2(path: Path) -> EventStream:
    """Events of a DAVIS240 recording in AEDAT 2.0; frames, IMU samples and triggers are left out.

    Raises:
        InputError: no readable file, or one longer than `MAX_BYTES`.
        EventsError: another format, a cut record, or events that no DAVIS240 could have sent.
    """
    data = read_input(path, MAX_BYTES)
    if not data.startswith(b"#!AER-DAT2.0"):
        raise EventsError(str(path), "a file that begins with #!AER-DAT2.0", f"{data[:12]!r}")
    begin = _header_length(data)
    if (len(data) - begin) % 8:
        raise EventsError(str(path), "records of 8 bytes", f"{(len(data) - begin) % 8} bytes left")
    records = np.frombuffer(data, ">u4", offset=begin).reshape(-1, 2)
    address, t_us = records[(records[:, 0] & ADDRESS_IS_NO_EVENT) == 0].T.astype(np.int64)
    # The chip counts both from the right and from below.
    x = DAVIS_WIDTH - 1 - ((address >> 12) & 0x3FF)
    y = DAVIS_HEIGHT - 1 - ((address >> 22) & 0x1FF)
    positive = (address >> 11) & 1
    return _stream(path, t_us, x, y, 2 * positive - 1, DAVIS_WIDTH, DAVIS_HEIGHT)


def _header_length(data: bytes) -> int:
    """Bytes of the lines that begin with #."""
    begin = 0
    while data[begin : begin + 1] == b"#":
        end = data.find(b"\n", begin)
        begin = len(data) if end < 0 else end + 1
    return begin


def read_event_lifetime(path: Path) -> EventStream:
    """Events of a DVS128 recording as MATLAB array `events`, rows of x y polarity t (us).

    Raises:
        InputError: no readable file.
        EventsError: no MATLAB file, no such array, or events that no DVS128 could have sent.
    """
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    subject = str(path)
    try:
        with open_input(path) as file:
            arrays = loadmat(file, variable_names=["events"])
    except (MatReadError, ValueError, TypeError, NotImplementedError, EOFError) as error:
        raise EventsError(subject, "a MATLAB file", str(error)) from error
    events = arrays.get("events")
    if events is None or events.ndim != 2 or events.shape[1] != 4 or events.dtype.kind not in "iu":
        found = "none" if events is None else f"{events.shape} of {events.dtype}"
        raise EventsError(subject, "an integer array events of shape (N, 4)", found)
    x, y, polarity, t_us = events.T.astype(np.int64)
    return _stream(path, t_us, x, y, polarity, DVS128_SIZE, DVS128_SIZE)


def _stream(
    path: Path, t_us: IntArray, x: Array, y: Array, polarity: Array, width: int, height: int
) -> EventStream:
    """A checked stream; what does not fit the columns' types is outside the sensor as well."""
    if len(t_us) == 0:
        raise EventsError(str(path), "at least one event", "none", reason="NO_EVENTS")
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height) & (np.abs(polarity) == 1)
    if not inside.all():
        index = int(np.argmin(inside))
        raise EventsError(
            str(path),
            f"x in [0, {width}), y in [0, {height}), polarity -1 or +1",
            f"{x[index]}, {y[index]}, {polarity[index]} at event {index}",
            reason="EVENT_OUT_OF_BOUNDS",
        )
    return EventStream(
        t_us=t_us, x=x, y=y, polarity=polarity.astype(np.int8), width=width, height=height
    )
