"""A picture of a registration: the map over the cloud, before and after."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.geometry.se3 import SE3
from roel_service.geometry.segments import sample_segments
from roel_service.scene.clouds import PointCloud
from roel_service.scene.lines import LineMap
from roel_service.scene.results import RegistrationResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Points drawn; more only make the cloud a blot.
POINT_COUNT = 40_000
# Lines of a target are drawn as points.
LINE_SPACING_M = 0.01
POINT_COLOR, LINE_COLOR = "#9aa0a6", "#d6336c"
# Views: title and the two axes of the target frame that span it.
VIEWS = (("from above", (0, 1)), ("from the side", (0, 2)))


def draw_registration(
    line_map: LineMap,
    target: PointCloud | LineMap,
    T_init: SE3,
    result: RegistrationResult,
    path: Path,
) -> None:
    """Write a PNG with the map where it was first thought to lie, and where it was found to."""
    from matplotlib.figure import Figure

    points = _points(target)
    before = T_init @ line_map.segments
    after = result.T_target_source @ (result.scale * line_map.segments)
    figure = Figure(figsize=(11, 9), dpi=110, layout="constrained")
    rows = figure.subplots(2, 2)
    for (view, plan), (left, right) in zip(VIEWS, rows, strict=True):
        _draw(left, points, before, plan)
        left.set_title(f"before, {view}")
        _draw(right, points, after, plan)
        right.set_title(f"{result.verdict.value}, fitness {result.fitness:.2f}, {view}")
    figure.savefig(path, format="png")


def _points(target: PointCloud | LineMap) -> FloatArray:
    """(N, 3) points of the target, at most `POINT_COUNT`."""
    if isinstance(target, LineMap):
        points, _ = sample_segments(target.segments, LINE_SPACING_M)
    else:
        points = target.points.astype(np.float64)
    count = min(POINT_COUNT, len(points))
    chosen = np.random.default_rng(0).choice(len(points), size=count, replace=False)
    return points[np.sort(chosen)]


def _draw(axes: Axes, points: FloatArray, segments: FloatArray, plan: tuple[int, int]) -> None:
    from matplotlib.collections import LineCollection

    axes.plot(*points[:, plan].T, ",", color=POINT_COLOR, alpha=0.5)
    axes.add_collection(LineCollection(list(segments[..., plan]), colors=LINE_COLOR, linewidths=1))
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.set_xlabel("xyz"[plan[0]] + ", m")
    axes.set_ylabel("xyz"[plan[1]] + ", m")
