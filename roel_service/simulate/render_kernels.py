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


# From here on without checks for division by zero, which does not happen: a quarter faster.
@numba.njit(cache=True, nogil=True, error_model="numpy")
def add_texel(
    texels: Array,
    offset: int,
    height: int,
    width: int,
    u: float,
    v: float,
    weight: float,
    total: Array,
) -> None:
    """Add the weighted bilinear value of one texture level to `total` (C,); the level repeats."""
    x, y = (u - np.floor(u)) * width - 0.5, (v - np.floor(v)) * height - 0.5
    column, row = int(np.floor(x)), int(np.floor(y))
    fx, fy = x - column, y - row
    left = column if column >= 0 else width - 1
    right = column + 1 if column + 1 < width else 0
    top = offset + (row if row >= 0 else height - 1) * width
    bottom = offset + (row + 1 if row + 1 < height else 0) * width
    for channel in range(len(total)):
        upper = texels[top + left, channel] * (1 - fx) + texels[top + right, channel] * fx
        lower = texels[bottom + left, channel] * (1 - fx) + texels[bottom + right, channel] * fx
        total[channel] += weight * (upper * (1 - fy) + lower * fy)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def texture_place(f: Array, x: float, y: float) -> tuple[float, float, float]:
    """u, v and depth of a triangle at a pixel, by its linear functions."""
    z = 1.0 / (f[0, 0] * x + f[0, 1] * y + f[0, 2])
    u = (f[1, 0] * x + f[1, 1] * y + f[1, 2]) * z
    v = (f[2, 0] * x + f[2, 1] * y + f[2, 2]) * z
    return u, v, z


@numba.njit(cache=True, nogil=True, error_model="numpy")
def footprint_texels(f: Array, u: float, v: float, z: float, height: int, width: int) -> float:
    """Size of a pixel on the texture, in texels along the longer direction."""
    size_u, size_v = width * z, height * z
    along_x = abs(f[1, 0] - u * f[0, 0]) * size_u + abs(f[2, 0] - v * f[0, 0]) * size_v
    along_y = abs(f[1, 1] - u * f[0, 1]) * size_u + abs(f[2, 1] - v * f[0, 1]) * size_v
    return float(max(along_x, along_y))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def shade(
    visible: Array,
    sample_offsets: Array,
    functions: Array,
    texture: Array,
    brightness: Array,
    texels: Array,
    offset: Array,
    height: Array,
    width: Array,
    level_count: Array,
    background: float,
    colour: Array,
) -> None:
    """Write the mean colour of the samples of every pixel.

    Texture levels are blended by the size of a sample's footprint. Where all samples hit one
    triangle whose texels are larger than the pixel, the texture is linear over the pixel and its
    middle is the mean.

    Args:
        visible: (S, H, W) triangle of each sample, -1 for none.
        sample_offsets: (S, 2) positions in the pixel.
        functions: (T, 3, 3) linear functions.
        texture: (T,) texture of each triangle.
        brightness: (T,) factor of its texture.
        texels, offset, height, width, level_count: a `TextureAtlas`.
        background: colour of what hits nothing.
        colour: (H, W, C) added to.
    """
    sample_count = len(visible)
    # A sample stands for a part of the pixel whose side is smaller by the root of their number.
    sharpness = 0.5 * np.log2(sample_count)
    for row in range(visible.shape[1]):
        for column in range(visible.shape[2]):
            total = colour[row, column]
            first = visible[0, row, column]
            same = first >= 0
            for sample in range(1, sample_count):
                same = same and visible[sample, row, column] == first
            if same:
                k = texture[first]
                u, v, z = texture_place(functions[first], column, row)
                size = footprint_texels(functions[first], u, v, z, height[k, 0], width[k, 0])
                if size < 1.0 or level_count[k] == 1:
                    place = offset[k, 0]
                    add_texel(
                        texels, place, height[k, 0], width[k, 0], u, v, brightness[first], total
                    )
                    continue
            for sample in range(sample_count):
                t = visible[sample, row, column]
                if t < 0:
                    total += background / sample_count
                    continue
                k = texture[t]
                weight = brightness[t] / sample_count
                x, y = column + sample_offsets[sample, 0], row + sample_offsets[sample, 1]
                u, v, z = texture_place(functions[t], x, y)
                level = 0.0
                if level_count[k] > 1:
                    size = footprint_texels(functions[t], u, v, z, height[k, 0], width[k, 0])
                    level = np.log2(max(size, 1e-9)) - sharpness
                    level = min(max(level, 0.0), level_count[k] - 1.0)
                below = int(level)
                share = level - below
                place = offset[k, below]
                add_texel(
                    texels,
                    place,
                    height[k, below],
                    width[k, below],
                    u,
                    v,
                    weight * (1.0 - share),
                    total,
                )
                if share > 0.0:
                    above = below + 1
                    place = offset[k, above]
                    add_texel(
                        texels,
                        place,
                        height[k, above],
                        width[k, above],
                        u,
                        v,
                        weight * share,
                        total,
                    )
