import contextlib
import struct
import zlib

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from roel_service.errors import EventsError
from roel_service.scene.events import EventStream
from roel_service.wire.chunks import (
    MAX_CHUNK_EVENT_COUNT,
    MAX_STEP_US,
    ChunkSummary,
    check_chunk,
    decode_chunk,
    encode_chunk,
    split_chunks,
)

HEADER = struct.Struct("<4sBBBBIIqqHHII")
NAMES = [
    *("magic", "version", "encoding", "width_bytes", "flags", "count", "payload_length"),
    *("t0", "t1", "width", "height", "crc", "reserved"),
]


def stream(t_us, x=None, y=None, positive=None, size=(640, 480)):
    count = len(t_us)
    x = np.arange(count) % size[0] if x is None else x
    y = np.arange(count) * 7 % size[1] if y is None else y
    positive = np.arange(count) % 3 == 0 if positive is None else positive
    return EventStream(
        t_us=t_us,
        x=x,
        y=y,
        polarity=np.where(positive, 1, -1),
        width=size[0],
        height=size[1],
    )


def assert_same_events(a, b):
    for name in ("t_us", "x", "y", "polarity"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert (a.width, a.height) == (b.width, b.height)


@st.composite
def streams(draw):
    size = draw(st.tuples(st.integers(1, 65_535), st.integers(1, 65_535)))
    count = draw(st.integers(1, 40))
    steps = draw(
        st.lists(
            st.sampled_from([0, 1, 255, 256, 65_535, 65_536, MAX_STEP_US]),
            min_size=count,
            max_size=count,
        )
    )
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    return stream(
        np.cumsum(steps) + draw(st.integers(-(2**62), 2**62)),
        rng.integers(0, size[0], count),
        rng.integers(0, size[1], count),
        rng.random(count) < 0.5,
        size,
    )


@given(streams())
def test_decoded_chunk_is_the_encoded_stream(events):
    assert_same_events(decode_chunk(encode_chunk(events), previous_t1_us=None), events)


@given(streams())
def test_a_checked_chunk_is_summarized(events):
    assert check_chunk(encode_chunk(events)) == ChunkSummary(
        event_count=len(events),
        t0_us=events.t_us[0],
        t1_us=events.t_us[-1],
        width=events.width,
        height=events.height,
        longest_step_us=max(np.diff(events.t_us), default=0),
    )


def test_layout_is_as_documented():
    # Nine events, so that the polarity bits need a second byte.
    t_us = np.array([-5, -5, 0, 300, 65_835, 65_836, 65_836, 65_837, 65_838])
    x = np.array([0, 1, 255, 256, 257, 639, 2, 3, 4])
    positive = np.array([1, 0, 0, 0, 0, 0, 0, 1, 1], bool)
    data = encode_chunk(stream(t_us, x, x % 480, positive))
    fields = dict(zip(NAMES, HEADER.unpack_from(data), strict=True))
    payload = data[48:]
    assert fields == {
        "magic": b"REC1",
        "version": 1,
        "encoding": 1,
        "width_bytes": 2,
        "flags": 0,
        "count": 9,
        "payload_length": len(payload),
        "t0": -5,
        "t1": 65_838,
        "width": 640,
        "height": 480,
        "crc": zlib.crc32(payload),
        "reserved": 0,
    }
    assert struct.unpack_from("<I", data, 44)[0] == zlib.crc32(data[:44])
    assert zstandard.get_frame_parameters(payload).content_size == (2 + 4) * 9 + 2
    raw = zstandard.ZstdDecompressor().decompress(payload)
    dt = [0, 0, 5, 300, 65_535, 1, 0, 1, 1]
    y = x % 480
    planes = np.array([[v % 256 for v in dt], [v // 256 for v in dt], x % 256, x // 256])
    planes = np.concatenate([planes, [y % 256, y // 256]])
    assert raw == planes.astype(np.uint8).tobytes() + bytes([0b10000001, 0b1])


def test_long_step_takes_four_bytes():
    data = encode_chunk(stream(np.array([0, 65_536])))
    assert data[6] == 4
    assert zstandard.get_frame_parameters(data[48:]).content_size == 8 * 2 + 1


def with_field(data, **changes):
    """The chunk with other header fields and the right checksums."""
    fields = dict(zip(NAMES, HEADER.unpack_from(data), strict=True)) | changes
    header = HEADER.pack(*fields.values())
    return header + struct.pack("<I", zlib.crc32(header)) + data[48:]


def with_payload(data, raw, **zstd):
    payload = zstandard.ZstdCompressor(**zstd).compress(raw)
    changes = {"payload_length": len(payload), "crc": zlib.crc32(payload)}
    return with_field(data[:48] + payload, **changes)


def refused(data, previous_t1_us=None):
    with pytest.raises(EventsError) as caught:
        decode_chunk(data, previous_t1_us=previous_t1_us)
    assert caught.value.subject in ("event chunk", "events")
    if previous_t1_us is None:
        with pytest.raises(EventsError) as checked:
            check_chunk(data)
        assert str(checked.value) == str(caught.value)
    return caught.value.reason


CHUNK = encode_chunk(stream(np.arange(9) * 10, size=(20, 64)))
RAW = zstandard.ZstdDecompressor().decompress(CHUNK[48:])


@given(st.integers(0, len(CHUNK) - 1), st.integers(1, 255))
def test_any_flipped_byte_is_refused(position, flip):
    data = bytearray(CHUNK)
    data[position] ^= flip
    assert refused(bytes(data)) in ("CHUNK_CRC_MISMATCH", "CHUNK_MALFORMED")


@given(st.integers(0, len(CHUNK) - 1))
def test_truncated_chunk_is_refused(size):
    assert refused(CHUNK[:size]) == "CHUNK_MALFORMED"


def test_trailing_byte_is_refused():
    assert refused(CHUNK + b"\0") == "CHUNK_MALFORMED"


@given(st.binary(max_size=100))
def test_any_bytes_are_refused(data):
    assert refused(data) == "CHUNK_MALFORMED"
    assert refused(b"REC1" + data) in ("CHUNK_CRC_MISMATCH", "CHUNK_MALFORMED")


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"version": 2}, "UNSUPPORTED_ENCODING"),
        ({"encoding": 2}, "UNSUPPORTED_ENCODING"),
        ({"width_bytes": 3}, "CHUNK_MALFORMED"),
        ({"width_bytes": 4}, "CHUNK_MALFORMED"),
        ({"flags": 1}, "CHUNK_MALFORMED"),
        ({"reserved": 1}, "CHUNK_MALFORMED"),
        ({"count": 0}, "CHUNK_MALFORMED"),
        ({"count": 10}, "CHUNK_MALFORMED"),
        ({"count": MAX_CHUNK_EVENT_COUNT + 1}, "CHUNK_MALFORMED"),
        ({"count": 2**32 - 1}, "CHUNK_MALFORMED"),
        ({"payload_length": 2**32 - 1}, "CHUNK_MALFORMED"),
        ({"t0": 1}, "CHUNK_MALFORMED"),
        ({"t1": 81}, "CHUNK_MALFORMED"),
        ({"t0": -(2**63), "t1": 2**63 - 1}, "CHUNK_MALFORMED"),
        ({"width": 8}, "EVENT_OUT_OF_BOUNDS"),
        ({"height": 0}, "EVENT_OUT_OF_BOUNDS"),
        ({"crc": 0}, "CHUNK_CRC_MISMATCH"),
    ],
)
def test_header_that_does_not_fit_is_refused(changes, reason):
    assert refused(with_field(CHUNK, **changes)) == reason


def test_payload_that_does_not_fit_is_refused():
    padded = bytearray(RAW)
    padded[-1] |= 0b10  # behind the ninth event
    late = bytearray(RAW)
    late[0] = 1  # the first step is 0 by definition
    for raw in (padded, late, RAW + b"\0", RAW[:-1], bytes(10**6)):
        assert refused(with_payload(CHUNK, bytes(raw))) == "CHUNK_MALFORMED"
    assert refused(with_payload(CHUNK, RAW, write_content_size=False)) == "CHUNK_MALFORMED"
    two_frames = CHUNK[48:] * 2
    changes = {"payload_length": len(two_frames), "crc": zlib.crc32(two_frames)}
    assert refused(with_field(CHUNK[:48] + two_frames, **changes)) == "CHUNK_MALFORMED"


@given(st.binary(max_size=60))
@settings(max_examples=50)
def test_any_payload_is_refused_or_valid(payload):
    changes = {"payload_length": len(payload), "crc": zlib.crc32(payload)}
    with contextlib.suppress(EventsError):
        data = with_field(CHUNK[:48] + payload, **changes)
        decoded = decode_chunk(data, previous_t1_us=None)
        assert len(decoded) == check_chunk(data).event_count == 9


def test_chunk_may_begin_when_the_one_before_ends_but_not_earlier():
    assert len(decode_chunk(CHUNK, previous_t1_us=0)) == 9
    assert refused(CHUNK, previous_t1_us=1) == "EVENT_TIME_NOT_MONOTONE"


@pytest.mark.parametrize(
    "t_us", [np.empty(0), np.zeros(MAX_CHUNK_EVENT_COUNT + 1), np.array([0, MAX_STEP_US + 1])]
)
def test_what_does_not_fit_a_chunk_is_not_encoded(t_us):
    with pytest.raises(EventsError) as caught:
        encode_chunk(stream(t_us))
    assert caught.value.reason == "CHUNK_MALFORMED"


class Source:
    """A recording that arrives in pieces of given sizes."""

    width, height = 640, 480

    def __init__(self, events, cuts):
        self.events = events
        self.cuts = [0, *cuts, len(events)]

    def chunks(self):
        e = self.events
        for start, stop in zip(self.cuts[:-1], self.cuts[1:], strict=True):
            part = slice(start, stop)
            yield stream(e.t_us[part], e.x[part], e.y[part], e.polarity[part] > 0)


@pytest.mark.parametrize("cuts", [[], [1], [50_000, 200_000], [131_072, 262_144], [0, 5, 5]])
def test_split_depends_on_the_events_alone(cuts):
    steps = np.ones(300_000, np.int64)
    steps[[140_000, 140_001]] = MAX_STEP_US + 1
    whole = stream(np.cumsum(steps))
    parts = list(split_chunks(Source(whole, cuts)))
    # Full chunks, ended early by each jump.
    assert [len(part) for part in parts] == [131_072, 8_928, 1, 131_072, 28_927]
    joined = [np.concatenate([getattr(p, name) for p in parts]) for name in ("t_us", "x")]
    np.testing.assert_array_equal(joined[0], whole.t_us)
    np.testing.assert_array_equal(joined[1], whole.x)
    previous = None
    for part in parts:
        previous = int(decode_chunk(encode_chunk(part), previous_t1_us=previous).t_us[-1])


def test_source_without_events_has_no_chunks():
    assert list(split_chunks(Source(stream(np.empty(0)), []))) == []
