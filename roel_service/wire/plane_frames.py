"""Byte planes of event chunks as zstd frames.

Two writers, one format: planes in which something repeats are left to zstd's search for that, and
those of a fast, busy sensor, whose pixels are noise to it, are packed without one (docs/decisions/
service-in-its-first-form.md).
"""

from __future__ import annotations

import zstandard

from roel_service.arrays import Array
from roel_service.wire.zstd_blocks import (
    BLOCK_BYTES,
    MAX_PACKED,
    MAX_UNARY,
    Block,
    frame,
    packed_bit_count,
    packed_block,
    raw_block,
    run_block,
    unary_block,
)

# Even where something repeats, what counts is the entropy coder. A tiny table of long matches is
# faster and smaller than level 3 (on a simulated room 2.66 against 2.68 bytes per event, three
# quarters of the time).
_ZSTD_PARAMETERS = zstandard.ZstdCompressionParameters(
    strategy=zstandard.STRATEGY_FAST,
    window_log=20,
    hash_log=6,
    chain_log=6,
    search_log=1,
    min_match=7,
    target_length=0,
)

# So many bytes of each plane are searched to learn whether searching pays; a thirty-second part.
_SAMPLE_BYTES = 2**12
# Packing may cost this much more than what searching would find.
_TOLERANCE = 1.02


def compressed(payload: Array, width_bytes: int, count: int) -> bytes:
    """One frame.

    Args:
        payload: planes of (count,) uint8: `width_bytes` of time steps, two of x, two of y; then bits.
    """
    blocks = None
    if (count, width_bytes) == (BLOCK_BYTES, 2):
        blocks = _noise_blocks(payload[: 6 * count].reshape(6, count), payload[6 * count :])
    return _searched(payload) if blocks is None else frame(blocks, len(payload))


def _searched(data: Array) -> bytes:
    return zstandard.ZstdCompressor(compression_params=_ZSTD_PARAMETERS).compress(data.data)


def _noise_blocks(planes: Array, signs: Array) -> list[Block] | None:
    """A block for each plane, None if a search would do better."""
    low_steps, high_steps, *pixels = planes
    longest_step, high_step, *largest = (int(plane.max()) for plane in planes)
    if longest_step > MAX_UNARY or high_step:
        return None
    middle = planes.shape[1] // 2
    sample = planes[2:, middle : middle + _SAMPLE_BYTES].flatten()
    packed_bytes = sum(map(_bit_count, largest)) * _SAMPLE_BYTES // 8
    if packed_bytes > _TOLERANCE * len(_searched(sample)):
        return None
    return [
        unary_block(low_steps, longest_step),
        run_block(0, len(high_steps)),
        *map(_pixel_block, pixels, largest),
        raw_block(signs),
    ]


def _bit_count(largest: int) -> int:
    """What `_pixel_block` spends on a value."""
    return packed_bit_count(largest) if largest else 0


def _pixel_block(plane: Array, largest: int) -> Block:
    if largest == 0:
        return run_block(0, len(plane))
    return packed_block(plane, largest) if largest <= MAX_PACKED else raw_block(plane)
