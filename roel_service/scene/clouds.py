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

    def sampled(self, count: int, rng: np.random.Generator) -> PointCloud:
        """`count` points, spread evenly over the surface, with the normals of their triangles."""
        corners = self.triangles.astype(np.float64)
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        double_area = np.linalg.norm(cross, axis=1)
        # Stratified: a point in each of `count` equal parts of the area, so that none stays bare.
        places = (np.arange(count) + rng.random(count)) / count * double_area.sum()
        triangle = np.searchsorted(np.cumsum(double_area), places).clip(max=len(self) - 1)
        u, v = rng.random((2, count, 1))
        folded = u + v > 1.0
        u, v = np.where(folded, 1.0 - u, u), np.where(folded, 1.0 - v, v)
        a, b, c = corners[triangle].transpose(1, 0, 2)
        normals = cross[triangle] / double_area[triangle, None]
        return PointCloud(points=a + u * (b - a) + v * (c - a), normals=normals)
