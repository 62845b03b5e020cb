"""Lines in parts of about as much work each, for threads."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from roel_service.arrays import IntArray

# Lines are worked on in so many parts, each in a thread.
PART_COUNT = 4


@dataclass(frozen=True, eq=False, kw_only=True)
class LinePart:
    """Some lines that follow each other, with their rows.

    Attributes:
        lines, rows: which.
        offsets: of their rows, within these.
    """

    lines: slice
    rows: slice
    offsets: IntArray


def line_parts(offsets: IntArray, count: int) -> list[LinePart]:
    """All lines in at most so many parts of about as many rows each; at least one part.

    Args:
        offsets: (L + 1,) of the rows of each line.
        count: at least 1.
    """
    ends_rows = np.linspace(0, offsets[-1], count + 1)[1:-1]
    ends = np.unique([0, *np.searchsorted(offsets[:-1], ends_rows), len(offsets) - 1])
    bounds = ends.tolist() if len(ends) > 1 else [0, 0]
    return [
        LinePart(
            lines=slice(first, last),
            rows=slice(int(offsets[first]), int(offsets[last])),
            offsets=offsets[first : last + 1] - offsets[first],
        )
        for first, last in pairwise(bounds)
    ]
