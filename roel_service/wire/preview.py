"""Events as a picture, without an imaging library: the front of the server draws it."""

from __future__ import annotations

import struct
import zlib

import numpy as np

from roel_service.arrays import Array, FloatArray
from roel_service.scene.events import EventSlice

# Larger sensors are shrunk by a whole factor.
MAX_SIDE_PX = 1280

# Pixels with so many times the mean number of events of a pixel that has some are the brightest.
SATURATION = 3.0


class EventPicture:
    """Counts of events; memory does not depend on how many there are.

    Args:
        width, height: sensor size, px.
    """

    def __init__(self, width: int, height: int) -> None:
        self._factor = -(-max(width, height) // MAX_SIDE_PX)
        self._shape = (-(-height // self._factor), -(-width // self._factor))
        self._positive = np.zeros(self._shape, np.int64)
        self._negative = np.zeros(self._shape, np.int64)

    def add(self, events: EventSlice) -> None:
        """Count more events."""
        pixel = events.y.astype(np.int64) // self._factor * self._shape[1]
        pixel += events.x // self._factor
        for counts, wanted in ((self._positive, 1), (self._negative, -1)):
            found = np.bincount(pixel[events.polarity == wanted], minlength=counts.size)
            counts += found.reshape(self._shape)

    def png(self) -> bytes:
        """The picture as a file: red where positive events are more, blue where negative ones are."""
        total = self._positive + self._negative
        brightness = _brightness(total)
        # From all blue at -1 to all red at 1; where both are equal, the pixel is violet.
        balance = (self._positive - self._negative) / np.maximum(total, 1)
        rgb = np.zeros((*self._shape, 3), np.uint8)
        rgb[..., 0] = 255 * brightness * np.clip(1 + balance, 0, 1)
        rgb[..., 2] = 255 * brightness * np.clip(1 - balance, 0, 1)
        return _png(rgb)


def _brightness(count: Array) -> FloatArray:
    """(H, W) from 0 to 1."""
    seen = count[count > 0]
    scale = SATURATION * seen.mean() if len(seen) else 1.0
    return np.asarray(np.clip(count / scale, 0, 1))


def _png(rgb: Array) -> bytes:
    """(H, W, 3) uint8 as a PNG file."""
    height, width, _ = rgb.shape
    # Every row begins with the number of its filter, 0 for none.
    rows = np.concatenate([np.zeros((height, 1), np.uint8), rgb.reshape(height, -1)], axis=1)
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = (
        (b"IHDR", header),
        (b"IDAT", zlib.compress(rows.tobytes(), 1)),
        (b"IEND", b""),
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(_png_part(kind, data) for kind, data in parts)


def _png_part(kind: bytes, data: bytes) -> bytes:
    crc = zlib.crc32(kind + data)
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", crc)
