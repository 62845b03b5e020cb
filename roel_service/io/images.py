"""Pictures: equirectangular panoramas and photographs, as JPEG or PNG."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from roel_service.arrays import Array
from roel_service.errors import PanoramaError
from roel_service.io.files import read_input
from roel_service.scene.camera import Camera

MIN_HEIGHT_PX, MAX_HEIGHT_PX = 256, 8192
# An uncompressed picture of the largest size, and then some.
MAX_FILE_BYTES = 512 << 20

PNG_MAGIC, PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND"
JPEG_MAGIC, JPEG_END = b"\xff\xd8\xff", b"\xff\xd9"
# Frame headers of JPEG: all of 0xC0 to 0xCF but the tables among them.
JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
JPEG_WITHOUT_LENGTH = frozenset([0x01, *range(0xD0, 0xD9)])


def read_panorama(path: Path) -> Array:
    """(H, 2H) uint8 grey values of a panorama file.

    Raises:
        InputError: no readable file.
        PanoramaError: as `decode_panorama`.
    """
    return decode_panorama(read_input(path, MAX_FILE_BYTES), str(path))


def decode_panorama(data: bytes, subject: str = "panorama") -> Array:
    """(H, 2H) uint8 grey values of an encoded panorama.

    The size is read from the header and checked before anything is decoded.

    Raises:
        PanoramaError: neither JPEG nor PNG, another shape, or data that do not decode whole.
    """
    width, height = _size(data, subject)
    if width != 2 * height or not MIN_HEIGHT_PX <= height <= MAX_HEIGHT_PX:
        expected = (
            f"a width of twice the height, and a height of {MIN_HEIGHT_PX} to {MAX_HEIGHT_PX}"
        )
        raise PanoramaError(subject, expected, f"{width} x {height}")
    return _decoded(data, width, height, subject)


def read_photograph(path: Path, camera: Camera) -> Array:
    """(H, W) uint8 grey values of a photograph file; raises as `decode_photograph`."""
    return decode_photograph(read_input(path, MAX_FILE_BYTES), camera, str(path))


def decode_photograph(data: bytes, camera: Camera, subject: str = "photograph") -> Array:
    """(H, W) uint8 grey values of an encoded photograph, as its camera took it.

    Raises:
        PanoramaError: neither JPEG nor PNG, another size than the camera's, or data that do not
            decode whole.
    """
    width, height = _size(data, subject)
    if (width, height) != (camera.width, camera.height):
        expected = f"{camera.width} x {camera.height}, as its camera has"
        raise PanoramaError(subject, expected, f"{width} x {height}")
    if max(width, height) > 2 * MAX_HEIGHT_PX:
        expected = f"sides of at most {2 * MAX_HEIGHT_PX}"
        raise PanoramaError(subject, expected, f"{width} x {height}")
    return _decoded(data, width, height, subject)


def _decoded(data: bytes, width: int, height: int, subject: str) -> Array:
    import cv2

    end = PNG_END if data.startswith(PNG_MAGIC) else JPEG_END
    # Decoders fill what is missing with grey; the end of the data is what a cut takes away.
    if end not in data[-4096:]:
        raise PanoramaError(subject, "a whole picture", "one that is cut off")
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    grey = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if grey is None or grey.shape != (height, width):
        raise PanoramaError(subject, "a picture that decodes", "damaged data")
    return np.asarray(grey)


def _size(data: bytes, subject: str) -> tuple[int, int]:
    """Width and height that the header tells."""
    size = None
    if data.startswith(PNG_MAGIC):
        size = _png_size(data)
    elif data.startswith(JPEG_MAGIC):
        size = _jpeg_size(data)
    if size is None:
        raise PanoramaError(subject, "a JPEG or PNG picture", "something else")
    return size


def _png_size(data: bytes) -> tuple[int, int] | None:
    if data[12:16] != b"IHDR" or len(data) < 24:
        return None
    return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    """From the first frame header among the segments."""
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # padding
            at += 1
        elif marker in JPEG_WITHOUT_LENGTH:
            at += 2
        elif marker in JPEG_FRAMES:
            height = int.from_bytes(data[at + 5 : at + 7], "big")
            return int.from_bytes(data[at + 7 : at + 9], "big"), height
        else:
            at += 2 + max(int.from_bytes(data[at + 2 : at + 4], "big"), 2)
    return None
