"""Lines and matches for LIMAP: LSD on blurred event frames, LBD descriptors, best-k matches.

LIMAP's own detectors and matchers need either downloaded weights (SOLD2, as in the RoEL paper) or
another OpenCV than ours; LSD and LBD are the two of its choices that OpenCV contrib has. What is
done here is what LIMAP does, and where event frames are unlike photographs, what favours it:
frames are blurred, the detector's bias is taken off, and both flanks of a ridge can be merged to
its centre line.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from roel_service.arrays import Array, BoolArray, FloatArray, IntArray
from roel_service.geometry.vectors import norm, unit
from roel_service.mapping.detect import LSD

# LBD describes a line by this many bits.
DESCRIPTOR_BITS = 256
# Two flanks of one ridge: their angle, and how much of the shorter one faces the other.
MAX_FLANK_ANGLE_DEG = 5.0
MIN_FLANK_OVERLAP = 0.5


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameLines:
    """The lines of one frame.

    Attributes:
        segments_px: (S, 2, 2) [line, endpoint, xy], pixel centres at integers.
        descriptors: (2, S, 32) uint8, LBD of the lines and of their reverse.
    """

    segments_px: FloatArray
    descriptors: Array

    def __len__(self) -> int:
        return len(self.segments_px)


def detected_lines(grey: Array, min_length_px: float, max_ridge_px: float) -> FrameLines:
    """LSD's lines of an (H, W) uint8 image, without its bias.

    Args:
        grey: blurred event frame, bright where events are.
        min_length_px: shorter lines are dropped.
        max_ridge_px: flanks that face each other this closely become their centre line; 0 keeps
            all flanks.
    """
    segments = LSD().detect(grey)
    if max_ridge_px > 0:
        segments = centre_lines(segments, max_ridge_px)
    segments = segments[norm(segments[:, 1] - segments[:, 0]) >= min_length_px]
    return FrameLines(
        segments_px=segments,
        descriptors=np.stack([described(grey, segments), described(grey, segments[:, ::-1])]),
    )


def centre_lines(segments_px: FloatArray, max_ridge_px: float) -> FloatArray:
    """Lines in the middle of ridges, longest first; lines without a partner stay as they are.

    LSD walks along an edge with the bright side on its right (x right, y down: to the side of
    (d_y, -d_x)), so that the two flanks of a bright ridge point against each other, each on the
    bright side of the other.

    Args:
        segments_px: (S, 2, 2).
        max_ridge_px: largest distance between flanks.
    """
    order = np.argsort(-norm(segments_px[:, 1] - segments_px[:, 0]), kind="stable")
    segments_px = segments_px[order]
    facing_px = _facing_px(segments_px, max_ridge_px)
    left = np.ones(len(segments_px), np.bool_)
    merged = []
    for i, segment in enumerate(segments_px):
        if not left[i]:
            continue
        partners_px = np.where(left, facing_px[i], 0.0)
        # A flank's other side is often broken; its pieces are the same ridge.
        left &= partners_px == 0
        left[i] = False
        if partners_px.any():
            segment = _middle(segment, segments_px[np.argmax(partners_px)])
        merged.append(segment)
    return np.array(merged).reshape(-1, 2, 2)


def _facing_px(segments_px: FloatArray, max_ridge_px: float) -> FloatArray:
    """(S, S) length over which j is the other flank of i; 0 where it is not."""
    start = segments_px[:, 0]
    length_px = norm(segments_px[:, 1] - start)
    direction = unit(segments_px[:, 1] - start)
    bright = np.stack([direction[:, 1], -direction[:, 0]], axis=1)
    opposed = direction @ direction.T < -np.cos(np.deg2rad(MAX_FLANK_ANGLE_DEG))
    ends = segments_px[None] - start[:, None, None]  # (i, j, endpoint, xy)
    width_px = np.einsum("ijex,ix->ije", ends, bright).mean(axis=2)
    along = np.einsum("ijex,ix->ije", ends, direction)
    facing = np.minimum(along.max(axis=2), length_px[:, None]) - np.maximum(along.min(axis=2), 0.0)
    shorter = np.minimum(length_px[:, None], length_px[None])
    near = (width_px > 0) & (width_px <= max_ridge_px)
    return np.where(opposed & near & (facing >= MIN_FLANK_OVERLAP * shorter), facing, 0.0)


def _middle(flank: FloatArray, other: FloatArray) -> FloatArray:
    """(2, 2) the line half-way between two opposed flanks, as long as both together."""
    other = other[::-1]
    direction = unit(flank[1] - flank[0] + other[1] - other[0])
    normal = np.array([-direction[1], direction[0]])
    offset_px = 0.5 * normal @ (flank.mean(axis=0) + other.mean(axis=0))
    along_px = np.concatenate([flank, other]) @ direction
    ends_px = np.array([along_px.min(), along_px.max()])
    return np.asarray(ends_px[:, None] * direction + offset_px * normal)


def described(grey: Array, segments_px: FloatArray) -> Array:
    """(S, 32) uint8 line band descriptors (Zhang and Koch, 2013), as OpenCV computes them."""
    if len(segments_px) == 0:
        return np.empty((0, DESCRIPTOR_BITS // 8), np.uint8)
    size = np.array(grey.shape[::-1]) - 1.0
    # The descriptor reads the image along the line; OpenCV does not check the ends.
    inside = np.clip(segments_px, 0.0, size)
    key_lines = [_key_line(ends, index, float(size.max())) for index, ends in enumerate(inside)]
    descriptor = cv2.line_descriptor.BinaryDescriptor.createBinaryDescriptor()
    _, bits = descriptor.compute(grey, key_lines)
    return np.asarray(bits, dtype=np.uint8)


def _key_line(ends: FloatArray, index: int, size_px: float) -> cv2.line_descriptor.KeyLine:
    (x1, y1), (x2, y2) = ends.tolist()
    line = cv2.line_descriptor.KeyLine()
    line.startPointX = line.sPointInOctaveX = x1
    line.startPointY = line.sPointInOctaveY = y1
    line.endPointX = line.ePointInOctaveX = x2
    line.endPointY = line.ePointInOctaveY = y2
    line.angle = float(np.arctan2(y2 - y1, x2 - x1))
    line.lineLength = float(np.hypot(x2 - x1, y2 - y1))
    line.numOfPixels = int(max(abs(x2 - x1), abs(y2 - y1))) + 1
    line.response = line.lineLength / size_px
    line.octave, line.class_id = 0, index
    return line


def best_matches(first: FrameLines, second: FrameLines, count: int) -> IntArray:
    """(Q, 2) lines of two frames, each among the best `count` of the other's, either way."""
    if len(first) == 0 or len(second) == 0:
        return np.empty((0, 2), np.int64)
    bits = hamming_distances(first.descriptors[0], second.descriptors)
    chosen = _smallest(bits, count) | _smallest(bits.T, count).T
    return np.argwhere(chosen)


def hamming_distances(queries: Array, descriptors: Array) -> IntArray:
    """(S, T) bits that differ between (S, 32) queries and the nearer of (2, T, 32) directions."""
    words, other_words = queries.view(np.uint64), descriptors.view(np.uint64)
    differences = np.bitwise_count(words[:, None, None] ^ other_words)
    return np.asarray(differences.sum(axis=-1, dtype=np.uint16).min(axis=1), dtype=np.int64)


def _smallest(values: IntArray, count: int) -> BoolArray:
    """(S, T) whether a value is among the smallest `count` of its row; earlier wins a tie."""
    if count >= values.shape[1]:
        return np.ones(values.shape, np.bool_)
    keys = values * values.shape[1] + np.arange(values.shape[1])
    return np.asarray(keys <= np.partition(keys, count - 1, axis=1)[:, count - 1 : count])
