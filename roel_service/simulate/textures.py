"""Pictures on surfaces, drawn by chance: (H, W, 3) float32, linear intensity, 0 to 1."""

from __future__ import annotations

import cv2
import numpy as np

from roel_service.arrays import Array

# Sub-pixel bits of OpenCV's drawing coordinates.
SHIFT = 4


def plain(colour: Array) -> Array:
    """One colour."""
    return np.asarray(colour, np.float32).reshape(1, 1, 3)


def mottled(colour: Array, contrast: float, size_px: int, rng: np.random.Generator) -> Array:
    """A colour with soft irregular variation, as of plaster or cloth."""
    noise = rng.normal(size=(size_px, size_px, 1)).astype(np.float32)
    soft = cv2.GaussianBlur(noise, (0, 0), 0.06 * size_px, borderType=cv2.BORDER_REFLECT)
    soft = (soft / soft.std())[..., None] * contrast
    return np.asarray(np.clip(colour * (1.0 + soft), 0.02, 1.0), dtype=np.float32)


def planks(board_count: int, rng: np.random.Generator) -> Array:
    """Floor boards of slightly different wood with dark joints, running along rows."""
    rows, columns = 24, 512
    base = np.array([0.45, 0.30, 0.18])
    image = np.empty((board_count * rows, columns, 3), np.float32)
    for board in range(board_count):
        strip = image[board * rows : (board + 1) * rows]
        strip[:] = base * rng.uniform(0.55, 1.25)
        joint = int(rng.integers(columns))
        strip[:, joint:] *= rng.uniform(0.75, 1.3)
        strip[:, joint : joint + 2] *= 0.4
        strip[:2] *= 0.4
    return image.clip(0.02, 1.0)


def tiles(count: int, rng: np.random.Generator) -> Array:
    """Square tiles with light joints."""
    size = 48
    shade = rng.uniform(0.25, 0.55, size=(count, count, 1)) * np.array([1.0, 0.95, 0.9])
    image = np.kron(shade, np.ones((size, size, 1))).astype(np.float32)
    for joint in range(count):
        image[joint * size : joint * size + 3] = 0.75
        image[:, joint * size : joint * size + 3] = 0.75
    return image


def stripes(count: int, rng: np.random.Generator) -> Array:
    """Coloured stripes of different widths along columns, as of a rug or curtain."""
    widths = rng.integers(6, 24, size=count)
    colours = rng.uniform(0.08, 0.85, size=(count, 3))
    row = np.repeat(colours, widths, axis=0)
    return np.broadcast_to(row, (8, *row.shape)).astype(np.float32).copy()


def poster(rng: np.random.Generator) -> Array:
    """A framed print of rectangles, bars and polygons."""
    height, width = 240, 320
    image = np.full((height, width, 3), rng.uniform(0.5, 0.95, 3), np.float32)
    for _ in range(int(rng.integers(4, 9))):
        centre = rng.uniform([40, 40], [width - 40, height - 40])
        reach = rng.uniform(15, 80, size=2)
        turn = rng.choice([0.0, 0.0, rng.uniform(0, np.pi)])
        rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        corners = centre + (np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * reach) @ rotation.T
        _fill(image, corners, rng.uniform(0.03, 0.9, 3))
    frame = rng.uniform(0.03, 0.25, 3)
    for border in (image[:12], image[-12:], image[:, :12], image[:, -12:]):
        border[:] = frame
    return image


def panels(rows: int, columns: int, colour: Array) -> Array:
    """A front of doors or drawers: panels parted by dark gaps, each with a handle."""
    size = 64
    image = np.empty((rows * size, columns * size, 3), np.float32)
    image[:] = colour
    for row in range(rows):
        for column in range(columns):
            cell = image[row * size : (row + 1) * size, column * size : (column + 1) * size]
            cell[:2] = cell[-2:] = 0.05
            cell[:, :2] = cell[:, -2:] = 0.05
            cell[size // 2 - 2 : size // 2 + 2, size // 3 : 2 * size // 3] = 0.08
    return image


def window(rng: np.random.Generator) -> Array:
    """Bright panes between bars, with a skyline behind them."""
    height, width = 256, 256
    image = np.empty((height, width, 3), np.float32)
    image[:] = np.array([0.75, 0.85, 0.95])
    left = 0
    while left < width:
        step = int(rng.integers(15, 50))
        top = int(rng.integers(height // 3, 4 * height // 5))
        image[top:, left : left + step] = rng.uniform(0.25, 0.6)
        left += step
    for bar in (0, width // 2 - 4, width - 8):
        image[:, bar : bar + 8] = 0.92
    for bar in (0, height // 2 - 4, height - 8):
        image[bar : bar + 8] = 0.92
    return image


def grid(cells: int, size_px: int = 512) -> Array:
    """White squares between black lines, as on each face of the paper's cube."""
    image = np.full((size_px, size_px, 3), 0.9, np.float32)
    half = size_px // 64
    for place in np.linspace(0, size_px, cells + 1).round().astype(int):
        image[max(0, place - half) : place + half] = 0.05
        image[:, max(0, place - half) : place + half] = 0.05
    return image


def _fill(image: Array, corners: Array, colour: Array) -> None:
    points = np.rint(corners * 2**SHIFT).astype(np.int32)
    cv2.fillConvexPoly(image, points, colour.tolist(), cv2.LINE_8, SHIFT)
