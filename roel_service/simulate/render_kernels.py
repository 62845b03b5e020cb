"""Loops over triangles and pixels: visibility by a depth buffer, then colour.

Inverse depth and texture coordinates over depth are linear in the image, so that each triangle
is three linear functions of the pixel: (a, b, c) . (x, y, 1).
"""

from __future__ import annotations

import numba
import numpy as np

from roel_service.arrays import Array

# Corners of a triangle cut by the near plane: at most four.
MAX_CORNERS = 4


@numba.njit(cache=True, nogil=True)
def clip_near(corners: Array, near: float, clipped: Array) -> int:
    """Cut (3, 5) corners x y z u v to z >= near; writes (4, 5), returns how many corners remain."""
    count = 0
    for i in range(3):
        p, q = corners[i], corners[(i + 1) % 3]
        if p[2] >= near:
            clipped[count] = p
            count += 1
        if (p[2] >= near) != (q[2] >= near):
            share = (near - p[2]) / (q[2] - p[2])
            clipped[count] = p + share * (q - p)
            count += 1
    return count


@numba.njit(cache=True, nogil=True)
def linear_functions(corners: Array, image: Array, functions: Array) -> bool:
    """Fit 1/z, u/z and v/z over a projected triangle; False where it is seen edge-on.

    Args:
        corners: (3, 5) x y z u v, camera frame.
        image: (3, 2) px.
        functions: (3, 3) written.
    """
    x0, y0 = image[0]
    ax, ay = image[1, 0] - x0, image[1, 1] - y0
    bx, by = image[2, 0] - x0, image[2, 1] - y0
    area = ax * by - ay * bx
    if abs(area) < 1e-9:
        return False
    for row in range(3):
        f0 = (1.0 if row == 0 else corners[0, 2 + row]) / corners[0, 2]
        fa = (1.0 if row == 0 else corners[1, 2 + row]) / corners[1, 2] - f0
        fb = (1.0 if row == 0 else corners[2, 2 + row]) / corners[2, 2] - f0
        functions[row, 0] = (fa * by - fb * ay) / area
        functions[row, 1] = (fb * ax - fa * bx) / area
        functions[row, 2] = f0 - functions[row, 0] * x0 - functions[row, 1] * y0
    return True


@numba.njit(cache=True, nogil=True)
def fill_convex(
    image: Array,
    count: int,
    inverse_depth: Array,
    triangle: int,
    offset_x: float,
    offset_y: float,
    nearest: Array,
    visible: Array,
) -> None:
    """Enter a convex polygon into the depth buffer, row by row.

    Args:
        image: (n, 2) px of the corners; the first `count` count.
        inverse_depth: (3,) linear function.
        triangle: number to write.
        offset_x, offset_y: position of the sample in its pixel.
        nearest: (H, W) inverse depth so far, updated.
        visible: (H, W) triangle so far, updated.
    """
    height, width = nearest.shape
    low, high = np.inf, -np.inf
    for i in range(count):
        low, high = min(low, image[i, 1]), max(high, image[i, 1])
    first_row = max(0, int(np.ceil(low - offset_y)))
    last_row = min(height - 1, int(np.floor(high - offset_y)))
    for row in range(first_row, last_row + 1):
        y = row + offset_y
        left, right = np.inf, -np.inf
        for i in range(count):
            j = (i + 1) % count
            y0, y1 = image[i, 1], image[j, 1]
            if (y0 <= y) == (y1 <= y):
                continue
            x = image[i, 0] + (y - y0) / (y1 - y0) * (image[j, 0] - image[i, 0])
            left, right = min(left, x), max(right, x)
        if left > right:
            continue
        first = max(0, int(np.ceil(left - offset_x)))
        last = min(width - 1, int(np.floor(right - offset_x)))
        value = inverse_depth[1] * y + inverse_depth[2] + inverse_depth[0] * (first + offset_x)
        for column in range(first, last + 1):
            if value > nearest[row, column]:
                nearest[row, column] = value
                visible[row, column] = triangle
            value += inverse_depth[0]


@numba.njit(cache=True, nogil=True)
def project_triangles(
    corners: Array, K: Array, near: float, width: int, height: int
) -> tuple[Array, Array, Array, Array]:
    """Corners in the image and linear functions of every triangle that may be in view.

    Args:
        corners: (T, 3, 5) x y z u v, camera frame.

    Returns:
        Images (T, 4, 2) px, corner counts (T,), 0 for what is out of view, linear functions
        (T, 3, 3), and the order (n,) of those in view, nearest corner first.
    """
    image = np.empty((len(corners), MAX_CORNERS, 2))
    counts = np.zeros(len(corners), np.int64)
    functions = np.zeros((len(corners), 3, 3))
    depth = np.full(len(corners), np.inf)
    clipped = np.empty((MAX_CORNERS, 5))
    for t in range(len(corners)):
        count = clip_near(corners[t], near, clipped)
        if count < 3:
            continue
        low_x, high_x, low_y, high_y = np.inf, -np.inf, np.inf, -np.inf
        for i in range(count):
            x = K[0, 0] * clipped[i, 0] / clipped[i, 2] + K[0, 2]
            y = K[1, 1] * clipped[i, 1] / clipped[i, 2] + K[1, 2]
            image[t, i, 0], image[t, i, 1] = x, y
            low_x, high_x = min(low_x, x), max(high_x, x)
            low_y, high_y = min(low_y, y), max(high_y, y)
            depth[t] = min(depth[t], clipped[i, 2])
        if high_x < -1 or low_x > width or high_y < -1 or low_y > height:
            depth[t] = np.inf
            continue
        if linear_functions(clipped[:3], image[t, :3], functions[t]):
            counts[t] = count
        else:
            depth[t] = np.inf
    order = np.argsort(depth)
    return image, counts, functions, order[: np.sum(np.isfinite(depth))]


@numba.njit(cache=True, nogil=True)
def fill_triangles(
    image: Array,
    counts: Array,
    functions: Array,
    order: Array,
    offset_x: float,
    offset_y: float,
    nearest: Array,
    visible: Array,
) -> None:
    """Enter the triangles of `project_triangles` into the depth buffer, see `fill_convex`."""
    for t in order:
        fill_convex(image[t], counts[t], functions[t, 0], t, offset_x, offset_y, nearest, visible)


@numba.njit(cache=True, nogil=True)
def texel(
    texels: Array, offset: int, height: int, width: int, u: float, v: float, colour: Array
) -> None:
    """Write the bilinear value of one repeating texture level to `colour` (C,)."""
    x, y = u * width - 0.5, v * height - 0.5
    column, row = int(np.floor(x)), int(np.floor(y))
    fx, fy = x - column, y - row
    left, right = column % width, (column + 1) % width
    top, bottom = (row % height) * width, ((row + 1) % height) * width
    for channel in range(len(colour)):
        upper = (1 - fx) * texels[offset + top + left, channel] + fx * texels[
            offset + top + right, channel
        ]
        lower = (1 - fx) * texels[offset + bottom + left, channel] + fx * texels[
            offset + bottom + right, channel
        ]
        colour[channel] = (1 - fy) * upper + fy * lower


@numba.njit(cache=True, nogil=True)
def shade(
    visible: Array,
    functions: Array,
    texture: Array,
    brightness: Array,
    texels: Array,
    offset: Array,
    height: Array,
    width: Array,
    level_count: Array,
    offset_x: float,
    offset_y: float,
    sharpness: float,
    background: float,
    total: Array,
) -> None:
    """Add the colour of one sample of every pixel.

    Texture levels are blended by the size of the sample's footprint in texels.

    Args:
        visible: (H, W) triangle, -1 for none.
        functions: (T, 3, 3) linear functions.
        texture: (T,) texture of each triangle.
        brightness: (T,) factor of its texture.
        texels, offset, height, width, level_count: a `TextureAtlas`.
        offset_x, offset_y: position of the sample in its pixel.
        sharpness: levels to stay below that of a whole pixel's footprint.
        background: colour of what hits nothing.
        total: (H, W, C) added to.
    """
    fine = np.empty(total.shape[2], np.float32)
    coarse = np.empty(total.shape[2], np.float32)
    for row in range(visible.shape[0]):
        y = row + offset_y
        for column in range(visible.shape[1]):
            t = visible[row, column]
            if t < 0:
                total[row, column] += background
                continue
            x = column + offset_x
            f = functions[t]
            z = 1.0 / (f[0, 0] * x + f[0, 1] * y + f[0, 2])
            u = (f[1, 0] * x + f[1, 1] * y + f[1, 2]) * z
            v = (f[2, 0] * x + f[2, 1] * y + f[2, 2]) * z
            k = texture[t]
            size_u, size_v = width[k, 0] * z, height[k, 0] * z
            along_x = abs(f[1, 0] - u * f[0, 0]) * size_u + abs(f[2, 0] - v * f[0, 0]) * size_v
            along_y = abs(f[1, 1] - u * f[0, 1]) * size_u + abs(f[2, 1] - v * f[0, 1]) * size_v
            footprint = max(along_x, along_y, 1e-9)
            level = min(max(np.log2(footprint) - sharpness, 0.0), level_count[k] - 1.0)
            below = int(level)
            above = min(below + 1, level_count[k] - 1)
            texel(texels, offset[k, below], height[k, below], width[k, below], u, v, fine)
            share = level - below
            if share > 0.0:
                texel(texels, offset[k, above], height[k, above], width[k, above], u, v, coarse)
                for channel in range(len(fine)):
                    fine[channel] += share * (coarse[channel] - fine[channel])
            for channel in range(len(fine)):
                total[row, column, channel] += brightness[t] * fine[channel]
