"""Surfaces without lines: point clouds and triangle meshes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roel_service.arrays import Array, frozen_array


@dataclass(frozen=True, eq=False, kw_only=True)
class PointCloud:
    """Points of a surface or of its edges.

    Attributes:
        points: (N, 3) float32, m.
        normals: (N, 3) float32 unit vectors, or None where unknown.
    """

    points: Array
    normals: Array | None = None

    def __post_init__(self) -> None:
        points = frozen_array(self.points, np.float32, (None, 3), "points")
        object.__setattr__(self, "points", points)
        if self.normals is not None:
            normals = frozen_array(self.normals, np.float32, (len(points), 3), "normals")
            object.__setattr__(self, "normals", normals)

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, eq=False, kw_only=True)
class TriangleMesh:
    """A soup of triangles.

    Attributes:
        triangles: (N, 3, 3) float32 [triangle, corner, coordinate], m.
    """

    triangles: Array

    def __post_init__(self) -> None:
        triangles = frozen_array(self.triangles, np.float32, (None, 3, 3), "triangles")
        object.__setattr__(self, "triangles", triangles)

    def __len__(self) -> int:
        return len(self.triangles)
