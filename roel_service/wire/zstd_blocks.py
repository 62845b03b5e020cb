"""zstd frames (RFC 8878) of byte planes in which nothing repeats, written without looking for it.

What makes such planes smaller is that their values are few or small. A compressor that looks for
repetitions finds short and useless ones, which cost both sides most of their time; here a plane
becomes one block of Huffman codes whose lengths are known beforehand, or of bytes as they are.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from roel_service.arrays import Array

# The most that a block may hold, and what every block of codes holds.
BLOCK_BYTES = 2**17
# Most values of which each takes the same number of bits.
MAX_PACKED = 15
# Codes have at most 11 bits, and unary ones two more than their value.
MAX_UNARY = 9

_MAGIC = bytes.fromhex("28b52ffd")
# One segment, with its size in four bytes.
_DESCRIPTOR = 0xA0
_FRAME_HEADER = struct.Struct("<4sBI")
_RAW, _RUN, _COMPRESSED = range(3)
# Literals behind a Huffman tree, in four streams, with sizes of 18 bits.
_FOUR_STREAMS = 0b1110
_STREAM_COUNT = 4
_JUMPS = struct.Struct("<HHH")
_NO_SEQUENCES = b"\0"
# The first byte of a tree whose weights follow as they are tells their number from here on.
_DIRECT_WEIGHTS = 127


class Block(NamedTuple):
    """A block; `size` is what its header tells."""

    kind: int
    size: int
    data: bytes


def frame(blocks: Sequence[Block], size_bytes: int) -> bytes:
    """Blocks as one frame, which decompresses to so many bytes."""
    parts = [_FRAME_HEADER.pack(_MAGIC, _DESCRIPTOR, size_bytes)]
    for left_count, block in zip(reversed(range(len(blocks))), blocks, strict=True):
        is_last = left_count == 0
        header = block.size << 3 | block.kind << 1 | is_last
        parts += [header.to_bytes(3, "little"), block.data]
    return b"".join(parts)


def raw_block(plane: Array) -> Block:
    """Bytes as they are."""
    return Block(_RAW, len(plane), plane.tobytes())


def run_block(value: int, count: int) -> Block:
    """One byte so many times."""
    return Block(_RUN, count, bytes([value]))


def packed_block(plane: Array, largest: int) -> Block:
    """(`BLOCK_BYTES`,) values up to `largest` in 1, 2 or 4 bits each."""
    bit_count = packed_bit_count(largest)
    return _huffman_block([1] * (2**bit_count - 1), _packed(plane, bit_count))


def packed_bit_count(largest: int) -> int:
    """Bits for each value up to `largest`; divides 8."""
    return next(count for count in (1, 2, 4, 8) if largest < 2**count)


def unary_block(plane: Array, largest: int) -> Block:
    """(`BLOCK_BYTES`,) values v up to `largest` in v + 1 bits each."""
    # Two values that do not occur get the longest codes, so that all others are zeros and a one.
    weights = range(largest + 2, 0, -1)
    return _huffman_block(weights, [_unary(part) for part in plane.reshape(_STREAM_COUNT, -1)])


def _packed(values: Array, bit_count: int) -> list[bytes]:
    """Streams of codes of one length; readers begin at their ends."""
    while bit_count < 8:
        # Of each pair the second value is the lower one.
        pairs = values.view("<u2")
        values = (pairs << np.uint16(bit_count) | pairs >> np.uint16(8)).astype(np.uint8)
        bit_count *= 2
    return [part[::-1].tobytes() + b"\1" for part in values.reshape(_STREAM_COUNT, -1)]


def _unary(values: Array) -> bytes:
    """A stream of v zeros and a one for each value; readers begin at its end."""
    places = values.astype(np.intp)
    places += 1
    np.cumsum(places, out=places)
    end = int(places[-1])
    bits: Array = np.zeros(end + 1, np.uint8)
    bits[np.subtract(end, places, out=places)] = 1
    bits[end] = 1
    return np.packbits(bits, bitorder="little").tobytes()


def _huffman_block(weights: Sequence[int], streams: Sequence[bytes]) -> Block:
    """`BLOCK_BYTES` literals.

    Args:
        weights: at most 15 each, of all values but the last, whose weight follows from them.
    """
    padded = [*weights, 0]
    nibbles = (high << 4 | low for high, low in zip(padded[::2], padded[1::2], strict=False))
    tree = bytes([_DIRECT_WEIGHTS + len(weights), *nibbles])
    jumps = _JUMPS.pack(*map(len, streams[:-1]))
    size = len(tree) + len(jumps) + sum(map(len, streams))
    header = (_FOUR_STREAMS | BLOCK_BYTES << 4 | size << 22).to_bytes(5, "little")
    data = b"".join((header, tree, jumps, *streams, _NO_SEQUENCES))
    return Block(_COMPRESSED, len(data), data)
