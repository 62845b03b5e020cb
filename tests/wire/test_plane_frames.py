"""Frames of both writers are read by zstd itself."""

import numpy as np
import pytest
import zstandard

from roel_service.wire.plane_frames import compressed
from roel_service.wire.zstd_blocks import (
    BLOCK_BYTES,
    MAX_UNARY,
    frame,
    packed_block,
    raw_block,
    run_block,
    unary_block,
)

COUNT = BLOCK_BYTES


def read(data):
    assert zstandard.get_frame_parameters(data).content_size > 0
    return zstandard.ZstdDecompressor().decompress(data, allow_extra_data=False)


def noise(largest, seed=0):
    return np.random.default_rng(seed).integers(0, largest + 1, COUNT).astype(np.uint8)


def payload(low_steps, x, y):
    """Of a chunk whose steps are small."""
    planes = [low_steps, np.zeros(COUNT), x % 256, x // 256, y % 256, y // 256, noise(255)[::8]]
    return np.concatenate([plane.astype(np.uint8) for plane in planes])


def noisy_payload(longest_step=3, width=640, height=480):
    rng = np.random.default_rng(1)
    steps = np.minimum(rng.geometric(0.7, COUNT) - 1, longest_step)
    steps[7] = longest_step
    return payload(steps, rng.integers(0, width, COUNT), rng.integers(0, height, COUNT))


@pytest.mark.parametrize("largest", [1, 2, 3, 7, 15])
def test_packed_block_takes_no_more_bits_than_the_largest_value_needs(largest):
    plane = noise(largest)
    data = frame([packed_block(plane, largest)], COUNT)
    assert read(data) == plane.tobytes()
    bits = {1: 1, 2: 2, 3: 2}.get(largest, 4)
    assert len(data) < COUNT * bits / 8 + 64


@pytest.mark.parametrize("largest", range(1, MAX_UNARY + 1))
def test_unary_block_takes_a_bit_more_than_the_value_says(largest):
    plane = noise(largest)
    plane[-1] = plane[0] = largest
    data = frame([unary_block(plane, largest)], COUNT)
    assert read(data) == plane.tobytes()
    assert len(data) < (plane.sum(dtype=int) + COUNT) / 8 + 64


def test_blocks_of_all_kinds_follow_one_another():
    planes = [noise(255), np.full(COUNT, 9, np.uint8), noise(3), noise(2, seed=1)]
    blocks = [
        raw_block(planes[0]),
        run_block(9, COUNT),
        packed_block(planes[2], 3),
        unary_block(planes[3], 2),
        raw_block(planes[0][:100]),
    ]
    data = frame(blocks, 4 * COUNT + 100)
    assert read(data) == b"".join(plane.tobytes() for plane in planes) + planes[0][:100].tobytes()


@pytest.mark.parametrize("size", [(256, 256), (640, 480), (1280, 720), (8192, 4096)])
def test_noise_is_packed_without_a_search(size):
    data = noisy_payload(width=size[0], height=size[1])
    packed = compressed(data, 2, COUNT)
    assert read(packed) == data.tobytes()
    bits = sum({1: 0, 2: 1, 3: 2, 5: 4, 16: 4, 32: 8}[-(-side // 256)] for side in size)
    expected = data[:COUNT].sum(dtype=int) + (1 + 8 + 8 + bits + 1) * COUNT
    assert expected / 8 < len(packed) < expected / 8 + 256


def test_repetitions_are_found():
    rows = np.repeat(np.arange(COUNT // 64) % 480, 64)
    data = payload(noise(1), np.arange(COUNT) % 640, rows)
    assert len(compressed(data, 2, COUNT)) < COUNT
    assert read(compressed(data, 2, COUNT)) == data.tobytes()


def test_steps_too_long_for_their_codes_are_searched():
    data = noisy_payload(longest_step=MAX_UNARY + 1)
    assert read(compressed(data, 2, COUNT)) == data.tobytes()


def test_a_step_above_one_byte_is_kept():
    data = noisy_payload()
    data[COUNT + 5] = 1
    assert read(compressed(data, 2, COUNT)) == data.tobytes()


def test_four_bytes_for_each_step_are_searched():
    wide = np.concatenate([noisy_payload(), noise(1), noise(1)])
    assert read(compressed(wide, 4, COUNT)) == wide.tobytes()
