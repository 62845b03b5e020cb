"""How a map fares on the round edges of a scene alone."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from roel_bench.results import Figures
from roel_service.arrays import Array, BoolArray, FloatArray

# Shares are given of points within these distances, mm.
DISTANCES_MM = (5, 10, 20)
# A point of the map farther than this from every true edge is a ghost of no edge in particular.
MAX_OWN_M = 0.1


def curve_figures(samples: FloatArray, edges: Array, curved_edges: Array) -> Figures:
    """Points of a map against the true points of round edges.

    A point of the map counts where the edge point nearest to it lies on a round edge and is within
    `MAX_OWN_M`; the others are judged by the figures of the map as a whole.

    Args:
        samples: (P, 3) points along the map's lines, m.
        edges: (M, 3) all true edge points, m.
        curved_edges: (K, 3) those of round edges, rows of `edges`.

    Returns:
        `curved_recall_*` and `curved_completion_mm` of the round edges' points,
        `curved_precision_*` and `curved_offset_median_mm`, the distance from the edge, of the
        map's; `straight_recall_20`; and how many points there are.
    """
    is_curved = _rows_of(edges, curved_edges)
    edge_mm = 1e3 * np.asarray(cKDTree(samples).query(edges)[0])
    offset_m, nearest = cKDTree(edges).query(samples)
    own = is_curved[nearest] & (offset_m < MAX_OWN_M)
    offset_mm = 1e3 * offset_m[own]
    figures: Figures = {
        "curved_edge_count": int(is_curved.sum()),
        "curved_sample_count": int(own.sum()),
        "curved_completion_mm": float(edge_mm[is_curved].mean()),
        "curved_offset_median_mm": float(np.median(offset_mm)) if own.any() else None,
        "straight_recall_20": float((edge_mm[~is_curved] <= 20).mean()),
    }
    for limit in DISTANCES_MM:
        recall = float((edge_mm[is_curved] <= limit).mean())
        precision = float((offset_mm <= limit).mean()) if own.any() else None
        figures |= {f"curved_recall_{limit}": recall, f"curved_precision_{limit}": precision}
    return figures


def _rows_of(points: Array, some: Array) -> BoolArray:
    """(M,) which of (M, 3) points are among (K, 3) others."""
    return np.asarray(cKDTree(some).query(points)[0] == 0.0)
