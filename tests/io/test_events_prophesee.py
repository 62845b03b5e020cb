"""EVT2, EVT3 and DAT files, written here word by word from the description of the formats."""

import struct

import numpy as np
import pytest

from roel_service.errors import EventsError
from roel_service.io import events_prophesee
from roel_service.io.events import open_events, read_events

WIDTH, HEIGHT = 1280, 720
HEADERS = {
    "evt2": b"% date 2020-01-01 00:00:00\n% evt 2.0\n% geometry 1280x720\n",
    "evt3": b"% camera_integrator_name Prophesee\n% format EVT3;height=720;width=1280\n% end\n",
    "dat": b"% Data file containing CD events.\n% Version 2\n% Height 720\n% Width 1280\n\x0c\x08",
}


def dat(*events):
    """(t, x, y, p) as they are."""
    return b"".join(struct.pack("<II", t % 2**32, x | y << 14 | p << 28) for t, x, y, p in events)


def evt2(*events):
    """A word of high time before each event whose upper bits differ."""
    words, high = [], None
    for t, x, y, p in events:
        if t >> 6 != high:
            high = t >> 6
            words.append(0x8 << 28 | high % 2**28)
        words.append(p << 28 | t % 64 << 22 | x << 11 | y)
    return struct.pack(f"<{len(words)}I", *words)


def evt3(*events):
    """Time, row and a single event each, without what is known already."""
    words, high, low, row = [], None, None, None
    for t, x, y, p in events:
        if t >> 12 != high:
            high, low = t >> 12, None
            words.append(0x8 << 12 | high % 2**12)
        if t % 4096 != low:
            low = t % 4096
            words.append(0x6 << 12 | low)
        if y != row:
            row = y
            words.append(0x0 << 12 | row)
        words.append(0x2 << 12 | p << 11 | x)
    return struct.pack(f"<{len(words)}H", *words)


ENCODERS = {"evt2": evt2, "evt3": evt3, "dat": dat}
FORMATS = pytest.mark.parametrize("encoding", ENCODERS)


def written(tmp_path, encoding, data, header=None):
    path = tmp_path / "recording"
    path.write_bytes((HEADERS[encoding] if header is None else header) + data)
    return path


def rows(stream):
    return list(zip(*(column.tolist() for column in columns_of(stream)), strict=True))


def columns_of(stream):
    return stream.t_us, stream.x, stream.y, stream.polarity


def signed(events):
    return [(t, x, y, 1 if p else -1) for t, x, y, p in events]


def drawn(count, duration_us, start_us=0):
    rng = np.random.default_rng(count)
    t_us = np.sort(rng.integers(start_us, start_us + duration_us, count))
    columns = t_us, rng.integers(0, WIDTH, count), rng.integers(0, HEIGHT, count)
    return list(zip(*(c.tolist() for c in (*columns, rng.integers(0, 2, count))), strict=True))


@FORMATS
@pytest.mark.parametrize("block_bytes", [8, 64, 1 << 20])
def test_events_are_those_that_were_written(tmp_path, monkeypatch, encoding, block_bytes):
    monkeypatch.setattr(events_prophesee, "_BLOCK_BYTES", block_bytes)
    events = drawn(300, 100_000)
    path = written(tmp_path, encoding, ENCODERS[encoding](*events))
    assert rows(read_events(path, WIDTH, HEIGHT)) == signed(events)
    assert open_events(path, WIDTH, HEIGHT).time_range_us == (events[0][0], events[-1][0])


@pytest.mark.parametrize(
    ("encoding", "bits"), [("evt2", 34), ("evt3", 24), ("dat", 32)], ids=["evt2", "evt3", "dat"]
)
@pytest.mark.parametrize("block_bytes", [16, 1 << 20])
def test_times_go_on_where_the_counter_wraps_around(
    tmp_path, monkeypatch, encoding, bits, block_bytes
):
    monkeypatch.setattr(events_prophesee, "_BLOCK_BYTES", block_bytes)
    period_us = 1 << bits
    times = [period_us - 5000, period_us - 1, period_us, period_us + 7000]
    times += [period_us + period_us // 3, period_us + 2 * period_us // 3, 2 * period_us + 3]
    events = [(t, 10, 20, 1) for t in times]
    path = written(tmp_path, encoding, ENCODERS[encoding](*events))
    assert [t for t, *_ in rows(read_events(path, WIDTH, HEIGHT))] == times


@pytest.mark.parametrize("block_bytes", [2, 6, 1 << 20])
def test_vectors_of_evt3_are_events_of_one_time_and_row(tmp_path, monkeypatch, block_bytes):
    monkeypatch.setattr(events_prophesee, "_BLOCK_BYTES", block_bytes)
    words = [
        0x8001,  # time, upper bits: 4096 us
        0x6002,  # lower bits: 2 us
        0x0005 | 0x800,  # row 5, of the other camera of a pair
        0x3000 | 0x800 | 100,  # vectors from column 100 on, positive
        0x4000 | 0b100000000001,  # 100 and 111
        0x5000 | 0b10000010,  # 113 and 119
        0x4000 | 0b10,  # 121
        0xA001,  # a trigger
        0x6003,
        0x2000 | 7,  # one event between, negative
        0x5000 | 0b1,  # 132
        0x3000 | 200,  # a new base, negative
        0x4000 | 0b1000,  # 203
        0x8002,  # the lower bits begin anew
        0x2000 | 9,
        0x8002,  # told once more, nothing begins
        0x6001,
        0x8002,
        0x2000 | 11,
    ]
    path = written(tmp_path, "evt3", struct.pack(f"<{len(words)}H", *words))
    expected = [(4098, x, 5, 1) for x in (100, 111, 113, 119, 121)]
    expected += [(4099, 7, 5, -1), (4099, 132, 5, 1), (4099, 203, 5, -1)]
    expected += [(8192, 9, 5, -1), (8193, 11, 5, -1)]
    assert rows(read_events(path, WIDTH, HEIGHT)) == expected


def test_what_comes_before_time_and_row_are_known_is_left_out(tmp_path):
    words = [0x2001, 0x6004, 0x2002, 0x8000, 0x2003, 0x4FFF, 0x0001, 0x4001, 0x2004]
    path = written(tmp_path, "evt3", struct.pack(f"<{len(words)}H", *words))
    # The lower bits came before the upper ones, and count for nothing.
    assert rows(read_events(path, WIDTH, HEIGHT)) == [(0, 4, 1, -1)]
    words = [0x1 << 28 | 5, 0x8 << 28 | 1, 0x1 << 28 | 6]
    path = written(tmp_path, "evt2", struct.pack("<3I", *words))
    assert rows(read_events(path, WIDTH, HEIGHT)) == [(64, 0, 6, 1)]


@FORMATS
def test_a_file_that_ends_within_a_word_is_refused(tmp_path, encoding):
    data = ENCODERS[encoding](*drawn(5, 100))
    with pytest.raises(EventsError) as caught:
        read_events(written(tmp_path, encoding, data[:-1]), WIDTH, HEIGHT)
    assert encoding.upper() in caught.value.expected


@pytest.mark.parametrize(
    ("header", "found"),
    [
        (b"% evt 2.1\n", "2.1"),
        (b"% format EVT21;height=720;width=1280\n", "EVT21"),
        (b"% Width 640\n\x0e\x08", "0e08"),
        (b"% Width 640\n", ""),
        (b"% a b\n" * 2000, "more"),
    ],
)
def test_another_header_is_refused(tmp_path, header, found):
    with pytest.raises(EventsError) as caught:
        open_events(written(tmp_path, "evt2", b"", header), WIDTH, HEIGHT)
    assert found in caught.value.found


@FORMATS
def test_a_file_without_events_is_refused(tmp_path, encoding):
    with pytest.raises(EventsError) as caught:
        read_events(written(tmp_path, encoding, b""), WIDTH, HEIGHT)
    assert caught.value.reason == "NO_EVENTS"


@FORMATS
def test_an_event_outside_of_the_sensor_is_refused(tmp_path, encoding):
    path = written(tmp_path, encoding, ENCODERS[encoding]((1, 5, 5, 1), (2, 640, 5, 1)))
    with pytest.raises(EventsError) as caught:
        read_events(path, 640, 480)
    assert caught.value.reason == "EVENT_OUT_OF_BOUNDS"
