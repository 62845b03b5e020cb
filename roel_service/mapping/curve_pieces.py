"""Short pieces of the edges of single frames, where no long line says that they are straight.

Edges are taken as the chains of pixels that the detector draws before it looks for lines, cut into
pieces so short that an arc is straight within a fraction of a pixel. Each piece gets its space-time
plane like a line does, which makes it sub-pixel accurate and tells its speed.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from roel_service.arrays import Array, BoolArray, FloatArray
from roel_service.config.stages import Config
from roel_service.geometry.vectors import norm
from roel_service.mapping.detect import EDLines, merge_seeds
from roel_service.mapping.frames import UNKNOWN_POLARITY, EventFrame
from roel_service.mapping.plane_fit import FittedLines, fit_space_time_planes
from roel_service.mapping.representations import EventImage

# Every other frame is enough: a curve is seen in dozens.
FRAME_STEP = 2
# Pixels that a piece has at the least.
MIN_PIXEL_COUNT = 5
# A supported run reaches this far beyond its piece.
EXTENSION_PX = 2.0
# A line this many times as long as a piece is straight, and pieces this near to it are its own.
STRAIGHT_PIECE_COUNT = 4.0
STRAIGHT_DISTANCE_PX = 2.0


def pieces_of_frame(
    images: Iterable[EventImage],
    lines: FittedLines,
    frame: EventFrame,
    drawing: EDLines,
    config: Config,
) -> FittedLines:
    """The pieces of one frame, without their events.

    Args:
        images: event images of the frame.
        lines: its straight lines.
        frame: its events.
        drawing: draws edges.
        config: `curves`, and `detect` and `plane_fit` for what pieces share with lines.
    """
    length_px = max(config.curves.piece_length_px, MIN_PIXEL_COUNT)
    pieces = np.concatenate(
        [np.empty((0, 2, 2)), *(cut(drawing.chains(image.grey), length_px) for image in images)]
    )
    pieces = pieces[~_along_lines(pieces, lines.segments_px, STRAIGHT_PIECE_COUNT * length_px)]
    polarity = np.full(len(pieces), UNKNOWN_POLARITY, np.int8)
    seeds = merge_seeds(pieces, polarity, config.detect)
    fit = replace(config.plane_fit, method="vote", extension_px=EXTENSION_PX, support_event_count=1)
    # The vote draws nothing.
    fitted = fit_space_time_planes(seeds, frame, fit, np.random.default_rng(0))
    return fitted.without_events()


def cut(chains: list[Array], length_px: float) -> FloatArray:
    """(S, 2, 2) pieces of chains of pixels, each along its principal axis.

    Args:
        chains: (n, 2) px each, neighbour by neighbour.
        length_px: a piece has about so many pixels.
    """
    starts: list[Array] = [np.empty(0, np.int64)]
    offset = 0
    for chain in chains:
        count = max(1, round(len(chain) / length_px))
        starts.append(offset + np.arange(count) * len(chain) // count)
        offset += len(chain)
    start = np.concatenate(starts)
    if len(start) == 0:
        return np.empty((0, 2, 2))
    pixels = np.concatenate(chains).astype(np.float64)
    sizes = np.diff(start, append=len(pixels))
    middle = np.add.reduceat(pixels, start) / sizes[:, None]
    centred = pixels - np.repeat(middle, sizes, axis=0)
    xx, yy = np.add.reduceat(centred**2, start).T
    xy = np.add.reduceat(centred[:, 0] * centred[:, 1], start)
    angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    axis = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    along = np.sum(centred * np.repeat(axis, sizes, axis=0), axis=1)
    ends = np.stack([np.minimum.reduceat(along, start), np.maximum.reduceat(along, start)], axis=1)
    pieces = middle[:, None] + ends[..., None] * axis[:, None]
    return np.asarray(pieces[sizes >= MIN_PIXEL_COUNT])


def _along_lines(pieces: FloatArray, lines: FloatArray, min_length_px: float) -> BoolArray:
    """(S,) whether both ends of a piece lie along one and the same long line."""
    length_px = norm(lines[:, 1] - lines[:, 0])
    lines, length_px = lines[length_px >= min_length_px], length_px[length_px >= min_length_px]
    direction = (lines[:, 1] - lines[:, 0]) / length_px[:, None]
    # One axis each for pieces, lines, ends and coordinates.
    from_start = pieces[:, None] - lines[None, :, :1]
    along = np.einsum("slex,lx->sle", from_start, direction)
    across = from_start[..., 1] * direction[:, None, 0] - from_start[..., 0] * direction[:, None, 1]
    beside = np.abs(across) < STRAIGHT_DISTANCE_PX
    within = (along > -EXTENSION_PX) & (along < length_px[:, None] + EXTENSION_PX)
    return np.asarray((beside & within).all(axis=-1).any(axis=-1))
