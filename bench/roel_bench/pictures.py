"""Pictures of maps over their truth, and of the lines of single frames over their events."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from roel_bench.front_end import FrameLines
from roel_bench.scenes import HeldBackEvents, LineTruth, MapTruth, Scene
from roel_service.arrays import Array, FloatArray
from roel_service.evaluation.figures import plan_axes
from roel_service.evaluation.maps import sample_lines
from roel_service.geometry.projection import clip_to_depth, project
from roel_service.scene.lines import LineMap
from roel_service.scene.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NEAR_M = 0.05
# Points of a picture; more only make it slow.
MAX_POINT_COUNT = 60_000
TRUTH_COLOR, MAP_COLOR, PATH_COLOR = "0.72", "#c92a2a", "#1c7ed6"
VIEW_PERCENT = (1, 99)


def draw_map(scene: Scene, entities: LineMap | FloatArray, title: str, path: Path) -> None:
    """Write a PNG of a map over the truth: from above, and as the camera sees it half-way.

    Args:
        scene: with poses.
        entities: lines, or (P, 3) points in m.
        title: above both.
        path: the PNG.
    """
    from matplotlib.figure import Figure

    if scene.trajectory is None:
        return
    figure = Figure(figsize=(13, 5.6), dpi=110, layout="constrained")
    above, ahead = figure.subplots(1, 2)
    figure.suptitle(title)
    truth = _thinned(_truth_points(scene))
    _draw_from_above(above, scene.trajectory, entities, truth)
    _draw_as_seen(ahead, scene, scene.trajectory, entities, truth)
    figure.savefig(path, format="png")


def _truth_points(scene: Scene) -> FloatArray:
    """(n, 3) m: what is known of the edges."""
    truth = scene.truth
    if isinstance(truth, LineTruth):
        return sample_lines(LineMap.from_segments(truth.segments))
    if isinstance(truth, MapTruth) and truth.edges is not None:
        return truth.edges.points.astype(np.float64)
    assert truth is None or isinstance(truth, HeldBackEvents | MapTruth)
    return np.empty((0, 3))


def _thinned(points: FloatArray) -> FloatArray:
    """Every so many points, to have no more than can be drawn."""
    return points[:: max(1, len(points) // MAX_POINT_COUNT)]


def _draw_from_above(
    axes: Axes, trajectory: Trajectory, entities: LineMap | FloatArray, truth: FloatArray
) -> None:
    plan = plan_axes(trajectory.T_world_camera.rotation)
    _draw(axes, truth @ plan, _flat(entities, plan))
    centres = trajectory.T_world_camera.translation @ plan
    axes.plot(*centres.T, color=PATH_COLOR, linewidth=1.2)
    shown = np.concatenate([truth @ plan, centres])
    if len(truth) == 0:
        shown = np.concatenate([_flat(entities, plan).reshape(-1, 2), centres])
    low, high = np.percentile(shown, VIEW_PERCENT, axis=0)
    margin = 0.1 * float((high - low).max()) + NEAR_M
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(low[1] - margin, high[1] + margin)
    axes.set_aspect("equal")
    axes.set_title("from above, m")


def _flat(entities: LineMap | FloatArray, plan: FloatArray) -> FloatArray:
    """Lines (L, 2, 2) or points (P, 2), in the plan."""
    return np.asarray((entities.segments if isinstance(entities, LineMap) else entities) @ plan)


def _draw_as_seen(
    axes: Axes,
    scene: Scene,
    trajectory: Trajectory,
    entities: LineMap | FloatArray,
    truth: FloatArray,
) -> None:
    half_way_us = np.array([(trajectory.t_us[0] + trajectory.t_us[-1]) // 2])
    T_camera_world = trajectory.interpolate(half_way_us)[0].inverse()
    K = scene.camera.matrix
    if isinstance(entities, LineMap):
        drawn = project(clip_to_depth(T_camera_world @ entities.segments, NEAR_M), K)
        drawn = drawn[np.isfinite(drawn).all(axis=(1, 2))]
    else:
        drawn = project(T_camera_world @ entities, K)
    _draw(axes, project(T_camera_world @ truth, K), drawn)
    axes.set_xlim(-0.5, scene.camera.width - 0.5)
    axes.set_ylim(scene.camera.height - 0.5, -0.5)
    axes.set_aspect("equal")
    axes.set_title("half-way, px; edges behind surfaces are drawn as well")


def _draw(axes: Axes, truth: FloatArray, drawn: FloatArray) -> None:
    """Points (n, 2) of the truth, and lines (L, 2, 2) or points (P, 2) of the map."""
    from matplotlib.collections import LineCollection

    axes.plot(*truth.T, ",", color=TRUTH_COLOR)
    if drawn.ndim == 3:
        axes.add_collection(LineCollection(list(drawn), colors=MAP_COLOR, linewidths=1.0))
    else:
        axes.plot(*_thinned(drawn).T, ",", color=MAP_COLOR)


def draw_frames(frames: list[FrameLines], title: str, path: Path) -> None:
    """Write a PNG of the lines of some frames over the events that they were found in."""
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5 * len(frames), 4.4), dpi=110, layout="constrained")
    figure.suptitle(title)
    for axes, found in zip(np.atleast_1d(figure.subplots(1, len(frames))), frames, strict=True):
        axes.imshow(_event_picture(found), cmap="gray_r", vmin=0, vmax=2)
        axes.add_collection(
            LineCollection(list(found.lines.segments_px), colors=MAP_COLOR, linewidths=1.2)
        )
        axes.set_title(f"{found.frame.events.t_ref_us * 1e-6:.3f} s")
        axes.set_axis_off()
    figure.savefig(path, format="png")


def _event_picture(found: FrameLines) -> Array:
    """(H, W) how many events of the smallest window fell on each pixel, 2 at the most."""
    start, stop = found.frame.windows[0]
    size = np.array([found.frame.width, found.frame.height])
    pixels = np.rint(found.frame.compensated_px[start:stop])
    pixels = pixels[((pixels >= 0) & (pixels < size)).all(axis=1)].astype(np.intp)
    counts = np.bincount(pixels[:, 1] * size[0] + pixels[:, 0], minlength=int(size.prod()))
    return np.minimum(counts, 2).reshape(size[1], size[0])
