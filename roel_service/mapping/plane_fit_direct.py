"""Space-time planes without detected lines: one for each cluster of events.

Paper: the "direct plane fitting" that it compares with. Candidate events are the clusters of a
DBSCAN in space-time in place of the neighbourhoods of detected lines, and more random planes are
tried; the ends of a line follow from its events, as in the line tracker of Everding and Conradt
(2018).
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.config.stages import PlaneFitConfig
from roel_service.mapping import dbscan_kernels, plane_fit_kernels

# The paper tries this many times as many planes as for a detected line.
TRIAL_FACTOR = 10
# Half the length of a uniform distribution, in standard deviations.
HALF_LENGTH_SIGMA = np.sqrt(3.0)


def fit_clusters(
    xy_px: FloatArray, tau_ms: FloatArray, config: PlaneFitConfig, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """One plane at the most for each cluster of the events.

    Args:
        xy_px: (K, 2), NaN outside the model of the camera.
        tau_ms: (K,) time since the frame.

    Returns:
        Lines (S, 2, 2), px, speeds (S,) px/ms along their left-hand normals and inlier counts (S,).
    """
    inside = np.isfinite(xy_px).all(axis=1)
    xy_px, tau_ms = xy_px[inside].astype(np.float64), tau_ms[inside]
    scaled = np.column_stack([xy_px, config.cluster_time_scale_px_per_ms * tau_ms])
    cluster = dbscan_kernels.dbscan(
        scaled, config.cluster_distance_px, config.cluster_min_event_count
    )
    points = np.column_stack([xy_px, config.time_scale_px_per_ms * tau_ms])
    order = np.argsort(cluster, kind="stable")
    bounds = np.searchsorted(cluster[order], np.arange(cluster.max(initial=-1) + 2))
    lines, speeds, scores = [np.empty((0, 2, 2))], [], []
    for start, stop in pairwise(bounds):
        members = points[order[start:stop]]
        plane, inliers = plane_fit_kernels.fit_plane(
            members,
            rng.random((TRIAL_FACTOR * config.trial_count, 3)),
            config.inlier_distance_px,
            config.min_inlier_count,
        )
        if np.isfinite(plane[0]):
            lines.append(_slice(plane, members[inliers])[None])
            speeds.append(-plane[2] * config.time_scale_px_per_ms)
            scores.append(float(inliers.sum()))
    return np.concatenate(lines), np.array(speeds), np.array(scores)


def _slice(plane: tuple[float, float, float, float], points: FloatArray) -> FloatArray:
    """(2, 2) segment at the frame's time, as long as its (n, 3) points are spread along it.

    Its left-hand normal is (a, b), along which the line moves by -c for each unit of scaled time.
    """
    a, b, _, offset = plane
    along = np.array([b, -a])
    position = points[:, :2] @ along
    reach = HALF_LENGTH_SIGMA * position.std()
    ends = position.mean() + np.array([-reach, reach])
    return np.asarray(offset * np.array([a, b]) + ends[:, None] * along)
