import contextlib
import hashlib
import json
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from roel_service.errors import MapFileError
from roel_service.scene.lines import LineMap
from roel_service.v1 import map_file_pb2
from roel_service.wire.provenance import Provenance
from roel_service.wire.rlm import (
    BLOCK_LINE_COUNT,
    MapBlocks,
    decode_map,
    encode_map,
    file_digest,
)

GOLDEN = Path(__file__).parents[1] / "golden"

PROVENANCE = Provenance(
    config_digest="sha256:12", events_sha256="ab", poses_sha256="cd", camera_sha256="ef"
)


def random_map(count, seed=0, size_m=6.0, length_m=0.5):
    rng = np.random.default_rng(seed)
    start = rng.uniform(-size_m / 2, size_m / 2, (count, 1, 3))
    return LineMap(
        segments=start + rng.normal(0, length_m, (count, 2, 3)),
        observation_count=rng.integers(0, 300, count),
        rms_residual_px=rng.uniform(0.02, 3.0, count),
        sigma_m=rng.uniform(0.001, 0.3, count),
    )


def permuted(line_map, seed=0):
    """The same undirected lines in another order, some turned round."""
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(line_map))
    segments = line_map.segments[order].copy()
    turned = rng.random(len(order)) < 0.5
    segments[turned] = segments[turned][:, ::-1]
    return LineMap(
        segments=segments,
        observation_count=line_map.observation_count[order],
        rms_residual_px=line_map.rms_residual_px[order],
        sigma_m=line_map.sigma_m[order],
    )


def canonical(segments):
    """Segments in one order and direction, for comparison."""
    points = segments.round(9)
    flip = [tuple(b) < tuple(a) for a, b in points]
    points[flip] = points[flip][:, ::-1]
    return np.array(sorted(points.reshape(-1, 6).tolist())).reshape(-1, 2, 3)


def assert_lines_match(decoded, original, step):
    """Each line of either map has a counterpart in the other, its ends half a step away."""
    assert len(decoded) == len(original)
    if len(original) == 0:
        return
    tolerance = step / 2 * (1 + 1e-6)  # and float64 rounding of the quotient
    for a, b in ((decoded, original), (original, decoded)):
        direct = np.abs(a[:, None] - b[None]).max(axis=(2, 3))
        turned = np.abs(a[:, None] - b[None, :, ::-1]).max(axis=(2, 3))
        assert np.minimum(direct, turned).min(axis=1).max() <= tolerance


def step_of(extent):
    return max(min(1e-3, extent / 2**13), extent / (2**21 - 1))


coordinates = st.floats(-1, 1, allow_subnormal=False)


@given(
    hnp.arrays(
        np.float64, st.tuples(st.integers(1, 12), st.just(2), st.just(3)), elements=coordinates
    ),
    st.sampled_from([1e-6, 1.0, 100.0, 1e7]),
)
@settings(max_examples=60, deadline=None)
def test_decoded_lines_are_within_half_a_step(segments, scale):
    segments = segments * scale
    extent = float(np.ptp(segments.reshape(-1, 3), axis=0).max())
    step = step_of(extent) or 1e-3
    long_enough = (np.abs(segments[:, 0] - segments[:, 1]) > step).any(axis=1)
    kept = segments[long_enough]
    map_file = decode_map(encode_map(LineMap.from_segments(kept), PROVENANCE))
    extent = float(np.ptp(kept.reshape(-1, 3), axis=0).max(initial=0)) if len(kept) else 0.0
    assert map_file.dropped_line_count == 0
    assert_lines_match(map_file.line_map.segments, kept, max(step, step_of(extent)))


@pytest.mark.parametrize("count", [1, BLOCK_LINE_COUNT, BLOCK_LINE_COUNT + 1, 10_000])
def test_blocks_join_to_the_whole_map(count):
    line_map = random_map(count)
    map_file = decode_map(encode_map(line_map, PROVENANCE))
    assert len(map_file.line_map) == count
    # Rounding to 1 mm moves a line's middle by at most as much per axis as its ends.
    total = line_map.segments.sum(axis=(0, 1))
    np.testing.assert_allclose(
        map_file.line_map.segments.sum(axis=(0, 1)), total, rtol=0, atol=count * 1e-3
    )
    np.testing.assert_allclose(
        map_file.bounds_max_m, line_map.segments.reshape(-1, 3).max(axis=0), rtol=0, atol=0
    )


def test_quality_is_kept_within_half_a_code():
    # Lines along x, ordered by their start, so that they keep their order.
    x = np.arange(50.0)
    segments = np.zeros((50, 2, 3))
    segments[:, 0, 0], segments[:, 1, 0] = x, x + 0.5
    line_map = LineMap(
        segments=segments,
        observation_count=np.r_[0:48, 65_535, 70_000],
        rms_residual_px=np.r_[0.0, np.geomspace(0.01, 600, 49)],
        sigma_m=np.r_[0.0, np.geomspace(1e-4, 6, 49)],
    )
    back = decode_map(encode_map(line_map, PROVENANCE)).line_map
    assert back.observation_count.tolist() == [*range(48), 65_535, 65_535]
    for name in ("rms_residual_px", "sigma_m"):
        values, decoded = getattr(line_map, name), getattr(back, name)
        assert decoded[0] == 0
        # Sixteen codes an octave: half a code is a factor of 2^(1/32), plus float32.
        ratio = np.log2(decoded[1:] / values[1:])
        assert np.abs(ratio).max() <= 1 / 32 + 1e-6


def test_quality_beyond_the_codes_saturates_and_never_becomes_unknown():
    line_map = LineMap(
        segments=np.array([[[0, 0, 0], [1, 0, 0]], [[2, 0, 0], [3, 0, 0]]]),
        observation_count=[1, 1],
        rms_residual_px=[1e-30, 1e30],
        sigma_m=[1e-30, 1e30],
    )
    back = decode_map(encode_map(line_map, PROVENANCE)).line_map
    np.testing.assert_allclose(back.rms_residual_px, [0.01, 0.01 * 2 ** (254 / 16)], rtol=1e-6)
    np.testing.assert_allclose(back.sigma_m, [1e-4, 1e-4 * 2 ** (254 / 16)], rtol=1e-6)


@given(st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_equal_maps_give_equal_bytes_in_any_order(seed):
    line_map = random_map(40, seed=7)
    doubled = LineMap(
        segments=np.concatenate([line_map.segments] * 2),
        observation_count=np.r_[line_map.observation_count, line_map.observation_count + 1],
        rms_residual_px=np.tile(line_map.rms_residual_px, 2),
        sigma_m=np.tile(line_map.sigma_m, 2),
    )
    data = encode_map(doubled, PROVENANCE)
    assert encode_map(permuted(doubled, seed), PROVENANCE) == data


def test_encoding_a_decoded_room_changes_nothing():
    once = decode_map(encode_map(random_map(500), PROVENANCE))
    twice = decode_map(encode_map(once.line_map, once.provenance))
    np.testing.assert_array_equal(
        canonical(twice.line_map.segments), canonical(once.line_map.segments)
    )
    np.testing.assert_array_equal(twice.line_map.sigma_m, once.line_map.sigma_m)


def test_header_tells_where_a_map_came_from():
    data = encode_map(random_map(5), PROVENANCE, frame_id="lab")
    map_file = decode_map(data)
    assert map_file.provenance == PROVENANCE
    assert map_file.frame_id == "lab"
    assert map_file.format_version == (1, 0)
    assert map_file.byte_count == len(data)
    assert map_file.digest == file_digest(data) == f"sha256:{hashlib.sha256(data).hexdigest()}"


def test_lines_within_a_step_are_dropped_and_counted():
    # 10 m across, so that a step is 1 mm.
    segments = np.array([[[0, 0, 0], [10, 0, 0]], [[0.5, 0, 0], [0.5001, 0, 0]]])
    map_file = decode_map(encode_map(LineMap.from_segments(segments), PROVENANCE))
    assert map_file.line_map.segments.tolist() == [[[0, 0, 0], [10, 0, 0]]]
    assert map_file.dropped_line_count == 1


@pytest.mark.parametrize("segments", [np.empty((0, 2, 3)), np.ones((3, 2, 3))])
def test_map_without_a_line_is_a_map(segments):
    map_file = decode_map(encode_map(LineMap.from_segments(segments), PROVENANCE))
    assert len(map_file.line_map) == 0
    assert map_file.dropped_line_count == len(segments)


def test_map_of_infinite_extent_is_refused():
    segments = np.array([[[-1e308, 0, 0], [1.5e308, 0, 0]]])
    with pytest.raises(MapFileError, match="an extent that float64 holds"):
        encode_map(LineMap.from_segments(segments), PROVENANCE)


def test_golden_file_of_version_1_0_is_decoded_for_ever():
    data = (GOLDEN / "map_1_0.rlm").read_bytes()
    expected = json.loads((GOLDEN / "map_1_0.json").read_text())
    map_file = decode_map(data)
    line_map = map_file.line_map
    assert list(map_file.format_version) == expected["format_version"] == [1, 0]
    assert map_file.frame_id == expected["frame_id"]
    assert map_file.provenance.config_digest == expected["config_digest"]
    assert map_file.dropped_line_count == expected["dropped_line_count"] == 1
    assert map_file.digest == expected["digest"]
    # The expectation is written with 6 decimals, m.
    np.testing.assert_allclose(line_map.segments, expected["segments"], rtol=0, atol=6e-7)
    assert line_map.observation_count.tolist() == expected["observation_count"]
    for name in ("rms_residual_px", "sigma_m"):
        np.testing.assert_allclose(getattr(line_map, name), expected[name], rtol=1e-6)


DATA = encode_map(random_map(30), PROVENANCE)


def refused(data):
    with pytest.raises(MapFileError) as caught:
        decode_map(data, subject="m.rlm")
    assert str(caught.value).startswith("m.rlm: expected an undamaged line map, found ")
    assert caught.value.reason == "MAP_FILE_INVALID"
    return caught.value.found


@given(st.integers(0, len(DATA) - 1), st.integers(1, 255))
def test_any_flipped_byte_is_refused(position, flip):
    data = bytearray(DATA)
    data[position] ^= flip
    refused(bytes(data))


@given(st.integers(0, len(DATA) - 1))
def test_truncated_file_is_refused(size):
    refused(DATA[:size])


def test_added_byte_is_refused():
    refused(DATA + b"\0")
    refused(b"\0" + DATA)


@given(st.binary(max_size=300))
def test_any_bytes_are_refused(content):
    refused(content)


def signed(content):
    """A file with the right checksum, as a hostile writer would make it."""
    return bytes(content) + hashlib.sha256(content).digest()


@given(
    st.lists(st.tuples(st.integers(0, len(DATA) - 33), st.integers(1, 255)), min_size=1, max_size=3)
)
@settings(max_examples=300, deadline=None)
def test_flips_under_a_right_checksum_are_refused_or_harmless(flips):
    content = bytearray(DATA[:-32])
    for position, flip in flips:
        content[position] ^= flip
    # The minor version is the one field that may differ; all else is checked again inside.
    with contextlib.suppress(MapFileError):
        assert decode_map(signed(content)).format_version != (1, 0) or content == DATA[:-32]


def with_header(**changes):
    """A file whose header is another, under right checksums and offsets."""
    length = struct.unpack_from("<I", DATA, 8)[0]
    header = map_file_pb2.MapHeader.FromString(DATA[16 : 16 + length])
    for name, value in changes.items():
        if isinstance(value, list):
            del getattr(header, name)[:]
            getattr(header, name).extend(value)
        else:
            setattr(header, name, value)
    return with_header_bytes(header.SerializeToString(deterministic=True))


def with_header_bytes(header):
    length = struct.unpack_from("<I", DATA, 8)[0]
    content = bytearray(DATA[:8] + struct.pack("<II", len(header), zlib.crc32(header)) + header)
    content += DATA[16 + length : -32]
    moved = len(header) - length
    index_offset = struct.unpack_from("<Q", content, len(content) - 20)[0] + moved
    struct.pack_into("<Q", content, len(content) - 20, index_offset)
    block_offset = struct.unpack_from("<Q", content, index_offset + 8)[0] + moved
    struct.pack_into("<Q", content, index_offset + 8, block_offset)
    return signed(content)


def test_header_may_change_under_right_checksums():
    assert decode_map(with_header(frame_id="elsewhere")).frame_id == "elsewhere"


@pytest.mark.parametrize(
    "changes",
    [
        {"line_count": 31},
        {"line_count": 2**32 - 1},
        {"step": 0.0},
        {"step": -1.0},
        {"step": float("nan")},
        {"step": 1e308},
        {"origin": [0.0, 0.0]},
        {"origin": [0.0, 0.0, float("inf")]},
        {"origin": [0.0, 0.0, 1.7e308]},
        {"column_ids": [1, 2, 3, 4, 5, 6]},
        {"column_ids": [1, 2, 3, 4, 5, 6, 6]},
        {"column_ids": [2, 1, 3, 4, 5, 6, 7]},
        {"column_ids": [1, 2, 3, 5, 6, 7, 8]},
    ],
)
def test_header_that_does_not_fit_is_refused(changes):
    refused(with_header(**changes))


def test_header_that_is_no_message_is_refused():
    assert refused(with_header_bytes(b"\xff\xff\xff")) == "a header that is none"


def test_other_major_version_is_refused_and_other_minor_is_not():
    for offset, expectation in ((4, refused), (6, decode_map)):
        content = bytearray(DATA[:-32])
        struct.pack_into("<H", content, offset, 2)
        expectation(signed(content))


class Block:
    """The one block of DATA taken apart, to be put together differently."""

    def __init__(self):
        self.index_offset = struct.unpack_from("<Q", DATA, len(DATA) - 52)[0]
        self.offset, length = struct.unpack_from("<QI", DATA, self.index_offset + 8)
        block = DATA[self.offset : self.offset + length]
        self.fields = list(struct.unpack_from("<4sIIHH6i", block))
        count = self.fields[3]
        self.entries = [
            list(struct.unpack_from("<BBHIII", block, 40 + 16 * k)) for k in range(count)
        ]
        position = 40 + 16 * count
        self.columns = []
        for entry in self.entries:
            self.columns.append(block[position : position + entry[4]])
            position += entry[4]

    def file(self, column_ids=None):
        directory = b""
        for entry, data in zip(self.entries, self.columns, strict=True):
            entry[4:] = [len(data), zlib.crc32(data)]
            directory += struct.pack("<BBHIII", *entry)
        body = directory + b"".join(self.columns)
        self.fields[1] = 40 + len(body)
        block = struct.pack("<4sIIHH6i", *self.fields) + body
        count, *box = self.fields[2], *self.fields[5:]
        digest = hashlib.sha256(block).digest()
        index = b"IDX1" + struct.pack("<I", 1)
        index += struct.pack("<QII6i32s", self.offset, len(block), count, *box, digest)
        content = DATA[: self.offset] + block + index
        trailer = struct.pack("<QII4s", self.offset + len(block), len(index), 30, b"RLME")
        return signed(content + trailer)


def test_block_put_together_again_is_the_file():
    assert Block().file() == DATA


@pytest.mark.parametrize(("field", "value"), [(0, 2), (1, 2), (2, 1), (3, 999), (3, 0)])
def test_column_entry_that_does_not_fit_is_refused(field, value):
    block = Block()
    block.entries[4][field] = value
    refused(block.file())


def test_raw_column_of_another_length_is_refused():
    block = Block()
    block.entries[5][1] = 0  # raw
    block.columns[5] = bytes(31)
    refused(block.file())


def test_column_values_outside_the_grid_are_refused():
    block = Block()
    block.entries[0][1:4] = [0, 0, 240]
    for codes in (bytes([255]) * 240, bytes(210) + bytes([128]) * 30):
        block.columns[0] = codes
        refused(block.file())


def test_line_without_length_is_refused():
    block = Block()
    for column in (1, 2, 3):
        block.entries[column][1:4] = [0, 0, 120]
        block.columns[column] = bytes(120)
    assert refused(block.file()) == "ends outside the grid"


def test_box_that_is_not_the_lines_is_refused():
    block = Block()
    block.fields[5] += 1
    assert refused(block.file()) == "another box"


def test_bytes_that_no_frame_declares_are_refused():
    block = Block()
    block.entries[1][1] = 1  # zstd
    for content in (b"", b"no frame", bytes(120)):
        block.columns[1] = content
        refused(block.file())


@pytest.mark.parametrize("count", [0, 5, BLOCK_LINE_COUNT + 3])
def test_blocks_are_the_parts_of_the_file(count):
    data = encode_map(random_map(count), PROVENANCE)
    blocks = MapBlocks(data)
    stored = [blocks.stored(block) for block in range(blocks.count)]
    assert blocks.head + b"".join(stored) + blocks.tail == data
    digests = [blocks.sha256(block) for block in range(blocks.count)]
    assert digests == [hashlib.sha256(block).digest() for block in stored]
    parts = [blocks.lines(block) for block in range(blocks.count)]
    whole = decode_map(data).line_map
    assert sum(len(part) for part in parts) == len(whole)
    for block, part in enumerate(parts):
        first = block * BLOCK_LINE_COUNT
        assert np.array_equal(part.segments, whole.segments[first : first + BLOCK_LINE_COUNT])
        lower, upper = blocks.bounds_m(block)
        assert np.array_equal(part.segments.reshape(-1, 3).min(axis=0), lower)
        assert np.array_equal(part.segments.reshape(-1, 3).max(axis=0), upper)


def test_blocks_of_a_damaged_file_are_refused():
    with pytest.raises(MapFileError, match="house: expected an undamaged line map"):
        MapBlocks(encode_map(random_map(5), PROVENANCE)[:-1], subject="house")


def test_a_room_takes_few_bytes_per_line():
    """Lines along the walls, a few millimetres off, as a build of a room gives them."""
    rng = np.random.default_rng(0)
    count = 600
    start = rng.uniform(0, 1, (count, 3)) * [5.6, 5.4, 2.8]
    # On a wall, the floor or the ceiling, and along an axis.
    start[np.arange(count), rng.integers(0, 3, count)] = 0
    steps = np.zeros((count, 3))
    steps[np.arange(count), rng.integers(0, 3, count)] = rng.uniform(0.1, 1.5, count)
    ends = np.stack([start, start + steps], axis=1) + rng.normal(0, 0.004, (count, 2, 3))
    line_map = LineMap(
        segments=ends,
        observation_count=rng.gamma(2, 20, count).astype(np.int32),
        rms_residual_px=rng.uniform(0.2, 0.6, count).astype(np.float32),
        sigma_m=rng.gamma(2, 0.005, count).astype(np.float32) + 1e-3,
    )
    data = encode_map(line_map, PROVENANCE)
    decoded = decode_map(data)
    assert len(data) <= 12 * count
    assert decoded.step_m <= 1e-3
    assert_lines_match(decoded.line_map.segments, ends, decoded.step_m)
