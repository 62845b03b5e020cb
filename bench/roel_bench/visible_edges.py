"""True edges as a camera sees them: the measure of lines found in one frame.

The paper compares 2D lines with the projection of its 3D edge map. Here points behind a surface are
left out first, by casting a ray to each.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import cv2
import numpy as np

from roel_bench.scenes import MapTruth
from roel_service.arrays import BoolArray, FloatArray
from roel_service.errors import CloudError
from roel_service.geometry.projection import project
from roel_service.geometry.se3 import SE3
from roel_service.scene.camera import Camera

# An edge point is the middle of a voxel and may lie inside its own surface by this much, seen at
# a grazing angle.
DEPTH_MARGIN_M = 0.03


class VisibleEdges:
    """Edge points of a scene and the surfaces that may hide them."""

    def __init__(self, truth: MapTruth, camera: Camera) -> None:
        if truth.edges is None:
            raise CloudError("truth", "edge points", "none")
        self._mesh = truth.mesh
        self._points = truth.edges.points.astype(np.float64)
        self._camera = camera

    @cached_property
    def _rays(self) -> Any:
        """Open3D's ray caster over the surfaces."""
        import open3d  # seconds to load, so only where a ray is cast

        corners = self._mesh.triangles.reshape(-1, 3)
        scene = open3d.t.geometry.RaycastingScene()
        scene.add_triangles(
            open3d.core.Tensor.from_numpy(corners),
            open3d.core.Tensor.from_numpy(np.arange(len(corners), dtype=np.uint32).reshape(-1, 3)),
        )
        return scene

    def is_visible(self, points: FloatArray, centre: FloatArray) -> BoolArray:
        """(N,) whether nothing stands between (N, 3) points and a (3,) camera centre, m."""
        import open3d

        towards = points - centre
        distance_m = np.linalg.norm(towards, axis=1)
        rays = np.concatenate([np.broadcast_to(centre, points.shape), towards], axis=1)
        hits = self._rays.cast_rays(open3d.core.Tensor.from_numpy(rays.astype(np.float32)))
        # Rays are as long as the way to the point: 1 is the point itself.
        return np.asarray(hits["t_hit"].numpy() * distance_m > distance_m - DEPTH_MARGIN_M)

    def points_in_view(self, T_world_camera: SE3) -> tuple[FloatArray, FloatArray]:
        """(n, 3) m, world, of the edge points that a pose sees, and their (n, 2) ideal pixels."""
        pixels = project(T_world_camera.inverse() @ self._points, self._camera.matrix)
        with np.errstate(invalid="ignore"):  # points behind the camera have no pixel
            size = (self._camera.width, self._camera.height)
            inside = ((pixels > -0.5) & (pixels < np.array(size) - 0.5)).all(axis=1)
        points, pixels = self._points[inside], pixels[inside]
        seen = self.is_visible(points, T_world_camera.translation)
        return points[seen], pixels[seen]

    def edge_map(self, T_world_camera: SE3) -> BoolArray:
        """(H, W) true edges as thin as lines are drawn.

        Points of one edge lie up to some pixels apart or beside each other; a closing joins them,
        and thinning leaves one pixel across.
        """
        _, pixels = self.points_in_view(T_world_camera)
        drawn = np.zeros((self._camera.height, self._camera.width), np.uint8)
        column, row = np.rint(pixels).astype(np.intp).T
        drawn[row, column] = 255
        joined = cv2.morphologyEx(drawn, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        return np.asarray(cv2.ximgproc.thinning(joined) > 0)

    def speed_px_per_ms(self, before: SE3, after: SE3, interval_ms: float) -> float:
        """Median speed of the visible edges between two poses; NaN where none are seen in both."""
        points, pixels = self.points_in_view(before)
        moved = project(after.inverse() @ points, self._camera.matrix) - pixels
        lengths = np.linalg.norm(moved, axis=1)
        lengths = lengths[np.isfinite(lengths)]
        return float(np.median(lengths)) / interval_ms if len(lengths) else float("nan")
