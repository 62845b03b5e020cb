"""A point cloud made ready for many registrations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from roel_service.arrays import FloatArray
from roel_service.config.stages import RegisterConfig
from roel_service.scene.clouds import PointCloud


@dataclass(frozen=True, eq=False, kw_only=True)
class PreparedCloud:
    """What the solvers look up in a cloud; immutable, so it can be kept and shared.

    Attributes:
        points: (N, 3) m, one for each occupied voxel.
        tree: of the points.
    """

    points: FloatArray
    tree: cKDTree


def prepare_cloud(cloud: PointCloud, config: RegisterConfig) -> PreparedCloud:
    """Thin a cloud, and make the search tree."""
    points = thin(cloud.points.astype(np.float64), config.voxel_m)
    return PreparedCloud(points=points, tree=cKDTree(points))


def thin(points: FloatArray, voxel_m: float) -> FloatArray:
    """(M, 3) means of the points in each occupied voxel; the order of the points plays no part."""
    cells = np.floor((points - points.min(axis=0)) / voxel_m).astype(np.int64)
    sizes = cells.max(axis=0) + 1
    keys = (cells[:, 0] * sizes[1] + cells[:, 1]) * sizes[2] + cells[:, 2]
    order = np.lexsort((*points.T, keys))
    starts = np.flatnonzero(np.diff(keys[order], prepend=-1))
    sums = np.add.reduceat(points[order], starts)
    return np.asarray(sums / np.diff(starts, append=len(points))[:, None])
