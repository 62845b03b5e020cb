"""Lines of one picture against true edges, pixel by pixel.

The protocol of the paper's tables on detection and plane fitting, which follows wireframe parsing
[Huang et al. 2018, Zhou et al. 2019]: both sides are drawn one pixel wide, pixels are matched one
to one within a distance, precision and recall are the matched shares, summed over all pictures. The
original matches pixels at the least total cost; here the nearest pairs go first, which is all but
the same and takes milliseconds.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numba
import numpy as np
from scipy.spatial import cKDTree

from roel_service.arrays import BoolArray, FloatArray, IntArray

# Largest distance of matched pixels, as a share of the picture's diagonal.
MATCH_DISTANCE_SHARE = 0.01
# Fraction bits of the drawn ends.
SUBPIXEL_BITS = 4


@dataclass(frozen=True, kw_only=True)
class PixelMatches:
    """Drawn pixels of lines and edges, and how many of them belong together."""

    line_pixel_count: int = 0
    edge_pixel_count: int = 0
    matched_count: int = 0

    def __add__(self, other: PixelMatches) -> PixelMatches:
        return PixelMatches(
            line_pixel_count=self.line_pixel_count + other.line_pixel_count,
            edge_pixel_count=self.edge_pixel_count + other.edge_pixel_count,
            matched_count=self.matched_count + other.matched_count,
        )

    @property
    def precision(self) -> float:
        return self.matched_count / max(1, self.line_pixel_count)

    @property
    def recall(self) -> float:
        return self.matched_count / max(1, self.edge_pixel_count)

    @property
    def f_score(self) -> float:
        """Harmonic mean of precision and recall."""
        return 2 * self.matched_count / max(1, self.line_pixel_count + self.edge_pixel_count)


def draw_lines(segments_px: FloatArray, shape: tuple[int, int]) -> BoolArray:
    """(H, W) whether a pixel lies on one of (S, 2, 2) segments, one pixel wide."""
    drawn = np.zeros(shape, np.uint8)
    ends = np.rint(segments_px * (1 << SUBPIXEL_BITS)).astype(np.int32)
    cv2.polylines(drawn, list(ends), isClosed=False, color=255, shift=SUBPIXEL_BITS)
    return np.asarray(drawn > 0)


def match_distance_px(shape: tuple[int, int]) -> float:
    """Largest distance of matched pixels in a picture of that shape."""
    return MATCH_DISTANCE_SHARE * float(np.hypot(*shape))


def match_pixels(lines: BoolArray, edges: BoolArray, distance_px: float) -> PixelMatches:
    """Pairs of one pixel each, no farther apart than `distance_px`, the nearest pairs first."""
    line_pixels, edge_pixels = np.argwhere(lines), np.argwhere(edges)
    matched_count = 0
    if len(line_pixels) and len(edge_pixels):
        near = cKDTree(line_pixels).sparse_distance_matrix(
            cKDTree(edge_pixels), distance_px, output_type="ndarray"
        )
        # Squared distances of pixels are small integers, which sort in linear time.
        order = np.argsort(np.rint(near["v"] ** 2).astype(np.uint16), kind="stable")
        first, second = near["i"][order], near["j"][order]
        matched_count = int(_count_pairs(first, second, len(line_pixels), len(edge_pixels)))
    return PixelMatches(
        line_pixel_count=len(line_pixels),
        edge_pixel_count=len(edge_pixels),
        matched_count=matched_count,
    )


@numba.njit(cache=True)
def _count_pairs(first: IntArray, second: IntArray, first_count: int, second_count: int) -> int:
    """Pairs taken in order, each index at most once."""
    first_is_free = np.ones(first_count, np.bool_)
    second_is_free = np.ones(second_count, np.bool_)
    count = 0
    for i, j in zip(first, second):  # noqa: B905  # numba's zip has no strict
        if first_is_free[i] and second_is_free[j]:
            first_is_free[i] = False
            second_is_free[j] = False
            count += 1
    return count
