"""Images of the events of one window, in several representations.

Paper: "Multi-window, Multi-representation Line Detection" (binary and timestamp images), and the
surfaces that it compares with: the Threshold-Ordinal Surface (Glover et al., luvHarris, 2021) and
the Speed-Invariant Time Surface (Manderscheid et al., 2019).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from roel_service.arrays import Array
from roel_service.config.stages import DetectConfig
from roel_service.mapping import representations_kernels
from roel_service.mapping.frames import UNKNOWN_POLARITY, EventFrame

# A count image saturates where a pixel holds this many times its 75th percentile: 1 - exp(-1.2).
COUNT_GAIN = 1.2
# Pixels with less than this many (spread) events do not count for that percentile.
MIN_COUNT = 0.05
# Patches of the ordinal surfaces reach this far from the event, as in their papers.
TOS_RADIUS_PX = 3
SITS_RADIUS_PX = 5


@dataclass(frozen=True, eq=False, kw_only=True)
class EventImage:
    """One representation of one window.

    Attributes:
        grey: (H, W) uint8.
        polarity: -1 or +1, or `UNKNOWN_POLARITY` where both are drawn.
    """

    grey: Array
    polarity: int


def event_images(frame: EventFrame, config: DetectConfig) -> Iterator[EventImage]:
    """Every representation of every window, smoothed."""
    for start, stop in frame.windows:
        if stop == start:
            continue
        for representation in config.representations:
            yield from REPRESENTATION_IMAGES[representation](frame, start, stop, config.blur_px)


def _counts(frame: EventFrame, start: int, stop: int) -> Array:
    images = np.zeros((2, frame.height, frame.width), np.float32)
    polarity = frame.events.polarity[start:stop]
    representations_kernels.splat(frame.compensated_px[start:stop], polarity, images)
    return images


def _binary(frame: EventFrame, start: int, stop: int, blur_px: float) -> Iterator[EventImage]:
    """White where an event fell."""
    rows = np.rint(frame.compensated_px[start:stop])
    inside = (rows >= 0).all(axis=1) & (rows < [frame.width, frame.height]).all(axis=1)
    column, row = rows[inside].astype(np.intp).T
    grey = np.zeros((frame.height, frame.width), np.float32)
    grey[row, column] = 255.0
    yield EventImage(grey=_smooth(grey, blur_px), polarity=UNKNOWN_POLARITY)


def _timestamp(frame: EventFrame, start: int, stop: int, blur_px: float) -> Iterator[EventImage]:
    """The last event's place in the window's time, an image a polarity [paper: timestamp image]."""
    t_us = frame.events.t_us[start:stop]
    span_us = max(1, int(t_us[-1] - t_us[0]))
    last_us = np.full((2, frame.height, frame.width), t_us[0])
    polarity = frame.events.polarity[start:stop]
    representations_kernels.latest(frame.compensated_px[start:stop], polarity, t_us, last_us)
    for label, times in zip((-1, 1), last_us, strict=True):
        grey = ((times - t_us[0]) * (255.0 / span_us)).astype(np.float32)
        yield EventImage(grey=_smooth(grey, blur_px), polarity=label)


def _count(frame: EventFrame, start: int, stop: int, blur_px: float) -> Iterator[EventImage]:
    """How many events fell, an image a polarity."""
    for label, counts in zip((-1, 1), _counts(frame, start, stop), strict=True):
        yield EventImage(grey=_tone_mapped(counts, blur_px), polarity=label)


def _count_sum(frame: EventFrame, start: int, stop: int, blur_px: float) -> Iterator[EventImage]:
    """How many events fell, both polarities together."""
    counts = _counts(frame, start, stop).sum(axis=0)
    yield EventImage(grey=_tone_mapped(counts, blur_px), polarity=UNKNOWN_POLARITY)


def _tos(frame: EventFrame, start: int, stop: int, blur_px: float) -> Iterator[EventImage]:
    """Threshold-ordinal surface: the newest edges, equally wide at any speed."""
    surface = np.zeros((frame.height, frame.width), np.uint8)
    representations_kernels.threshold_ordinal(
        frame.compensated_px[start:stop], TOS_RADIUS_PX, surface
    )
    yield EventImage(grey=_smooth(surface.astype(np.float32), blur_px), polarity=UNKNOWN_POLARITY)


def _sits(frame: EventFrame, start: int, stop: int, blur_px: float) -> Iterator[EventImage]:
    """Speed-invariant time surface, an image a polarity."""
    surfaces = np.zeros((2, frame.height, frame.width), np.uint8)
    representations_kernels.speed_invariant(
        frame.compensated_px[start:stop],
        frame.events.polarity[start:stop],
        SITS_RADIUS_PX,
        surfaces,
    )
    newest = (2 * SITS_RADIUS_PX + 1) ** 2
    for label, surface in zip((-1, 1), surfaces, strict=True):
        grey = surface * np.float32(255.0 / newest)
        yield EventImage(grey=_smooth(grey, blur_px), polarity=label)


REPRESENTATION_IMAGES = {
    "binary": _binary,
    "timestamp": _timestamp,
    "count": _count,
    "count_sum": _count_sum,
    "tos": _tos,
    "sits": _sits,
}


def _smooth(grey: Array, blur_px: float) -> Array:
    if blur_px > 0:
        grey = cv2.GaussianBlur(grey, (0, 0), blur_px)
    return np.asarray(np.rint(grey), dtype=np.uint8)


def _tone_mapped(counts: Array, blur_px: float) -> Array:
    """255 (1 - exp(-1.2 g / g75)): dense edges do not drown sparse ones."""
    if blur_px > 0:
        counts = cv2.GaussianBlur(counts, (0, 0), blur_px)
    drawn = counts[counts > MIN_COUNT]
    if len(drawn) == 0:
        return np.zeros(counts.shape, np.uint8)
    scale = COUNT_GAIN / np.percentile(drawn, 75)
    return np.asarray(np.rint(255.0 * (1.0 - np.exp(-scale * counts))), dtype=np.uint8)
