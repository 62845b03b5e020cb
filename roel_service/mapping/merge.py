"""Duplicates among triangulated lines.

Paper: "3D Line Reconstruction" (implementation details): DBSCAN on direction, disparity and centre
position; of each cluster the longest line stays.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from roel_service.arrays import BoolArray, FloatArray, IntArray
from roel_service.config.stages import TriangulateConfig
from roel_service.geometry import plucker
from roel_service.geometry.vectors import norm
from roel_service.mapping.frames import Frames
from roel_service.mapping.refine import Refined
from roel_service.mapping.trim import covered_spans
from roel_service.mapping.views import Views
from roel_service.scene.results import TrackStatus


def merge_duplicates(
    refined: Refined, views: Views, frames: Frames, config: TriangulateConfig
) -> tuple[Refined, list[TrackStatus]]:
    """The longest line of every cluster, and a status for each that went.

    With a minimum cluster size of one, DBSCAN's clusters are the connected components of the graph
    of neighbours.
    """
    if len(refined) == 0:
        return refined, []
    spans_m = covered_spans(refined.lines, refined.tracks, views)
    length_m = np.nan_to_num(spans_m[:, 1] - spans_m[:, 0])
    neighbours = _neighbours(refined, spans_m, views, frames, config)
    cluster = csgraph.connected_components(sparse.csr_matrix(neighbours), directed=False)[1]
    longest = _first_of_each(cluster, np.argsort(-length_m, kind="stable"))
    dropped = [TrackStatus.MERGED] * (len(refined) - len(longest))
    return refined.take(longest), dropped


def _neighbours(
    refined: Refined, spans_m: FloatArray, views: Views, frames: Frames, config: TriangulateConfig
) -> BoolArray:
    """(L, L) which lines agree in direction, disparity and centre.

    Disparity is that of a baseline as long as the cameras are spread (their root mean square
    distance from the mean), in px; centres are compared in px at the lines' distance.
    """
    direction = refined.lines.direction
    ends = plucker.endpoints_from_plucker(direction, refined.lines.moment, spans_m)
    centre = ends.mean(axis=1)
    cameras = frames.T_world_camera.translation
    spread_m = float(np.sqrt(np.mean(np.sum((cameras - cameras.mean(axis=0)) ** 2, axis=1))))
    distance_m = norm(centre - refined.origin)
    disparity_px = frames.focal_px * spread_m / distance_m
    nearer_m = np.minimum(distance_m[:, None], distance_m[None])
    apart_px = frames.focal_px * norm(centre[:, None] - centre[None]) / nearer_m
    cosine = np.abs(direction @ direction.T)
    agree = cosine > np.cos(np.deg2rad(config.merge_angle_deg))
    agree &= np.abs(disparity_px[:, None] - disparity_px[None]) < config.merge_disparity_px
    agree &= apart_px < config.merge_center_px
    return np.asarray(agree)


def _first_of_each(cluster: IntArray, order: IntArray) -> IntArray:
    """Indices, ascending, of the first member of each cluster in the given order."""
    first = np.unique(cluster[order], return_index=True)[1]
    return np.sort(order[first])
