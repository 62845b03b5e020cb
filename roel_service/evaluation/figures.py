"""A picture of a map: over the events of one moment, and from above."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from roel_service.arrays import Array, BoolArray, FloatArray, IntArray
from roel_service.geometry.projection import (
    clip_to_depth,
    distort,
    normalized_from_pixel,
    pixel_from_normalized,
    undistort,
)
from roel_service.geometry.se3 import SE3
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventSource
from roel_service.scene.lines import LineMap
from roel_service.scene.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Points of the drawn path; every so many of them compete for the view over the events.
PATH_POINT_COUNT = 241
VIEW_STRIDE = 5
# A segment is drawn in this many pieces, so that it may bend with the lens and change colour.
PIECE_COUNT = 24
# Events of the picture: a fraction of the pixels, from a time short enough not to smear.
EVENTS_PER_PIXEL = 0.15
MAX_HALF_WINDOW_US = 15_000
# Lines end this share of the median distance before the camera's plane.
NEAR_SHARE = 1e-3
# Distortion polynomials are valid inside the image; this much beyond is still drawn.
FIELD_MARGIN = 1.05
# A world axis this near to the cameras' mean upward direction is taken for the vertical.
MAX_TILT_RAD = math.radians(30)

POSITIVE_RGB, NEGATIVE_RGB = (0.62, 0.76, 0.97), (0.98, 0.72, 0.66)
PATH_COLOR, UNSEEN_COLOR = "#d6336c", "#9aa0a6"
DEPTH_COLORS = "turbo"


def draw_map(
    line_map: LineMap, trajectory: Trajectory, camera: Camera, events: EventSource, path: Path
) -> None:
    """Write a PNG of the map, over the events where most of it is in view, and from above.

    Args:
        line_map: at least one line, world frame.
        trajectory: poses of the camera.
        camera: calibration, with its distortion.
        events: the recording, on the clock of the trajectory; read twice, in chunks.
        path: the PNG.
    """
    from matplotlib.figure import Figure

    times_us = _times_us(trajectory, events)
    T_world_camera = trajectory.interpolate(times_us)
    view = best_view(line_map, camera, times_us, T_world_camera)
    aspect = camera.width / camera.height
    figure = Figure(figsize=(5.2 * (aspect + 1.2), 5.4), dpi=150, layout="constrained")
    over_events, from_above = figure.subplots(1, 2, width_ratios=[aspect, 1])
    lines = _draw_over_events(over_events, view, camera, event_image(events, view.t_us))
    over_events.set_title(f"{len(line_map)} lines over the events at {view.t_us * 1e-6:.3f} s")
    _draw_from_above(from_above, line_map, T_world_camera, camera, view)
    from_above.set_title("from above, with the camera's path")
    figure.colorbar(lines, ax=[over_events, from_above], shrink=0.8, pad=0.01, label="depth, m")
    figure.savefig(path, format="png")


@dataclass(frozen=True, eq=False, kw_only=True)
class View:
    """All lines as one camera sees them.

    Attributes:
        t_us: moment of the view.
        T_world_camera: its pose.
        pixels: (L, PIECE_COUNT + 1, 2) raw px; NaN outside the field of view.
        depth_m: (L, PIECE_COUNT + 1).
    """

    t_us: int
    T_world_camera: SE3
    pixels: FloatArray
    depth_m: FloatArray

    @property
    def is_seen(self) -> BoolArray:
        """(L,) whether any of the line is in view."""
        return np.asarray(np.isfinite(self.pixels[..., 0]).any(axis=1))

    @property
    def pieces(self) -> tuple[FloatArray, FloatArray]:
        """(Q, 2, 2) px and (Q,) depth in m of the pieces in view."""
        ends = np.stack([self.pixels[:, :-1], self.pixels[:, 1:]], axis=2).reshape(-1, 2, 2)
        depth_m = 0.5 * (self.depth_m[:, :-1] + self.depth_m[:, 1:]).reshape(-1)
        seen = np.isfinite(ends).all(axis=(1, 2))
        return ends[seen], depth_m[seen]

    @property
    def seen_length_px(self) -> float:
        ends, _ = self.pieces
        return float(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).sum())


def _times_us(trajectory: Trajectory, events: EventSource) -> IntArray:
    """Evenly spaced moments with both poses and events."""
    first_us, last_us = events.time_range_us or _time_range_us(events)
    start_us, stop_us = (
        max(first_us, int(trajectory.t_us[0])),
        min(last_us, int(trajectory.t_us[-1])),
    )
    return np.linspace(start_us, stop_us, PATH_POINT_COUNT).astype(np.int64)


def _time_range_us(events: EventSource) -> tuple[int, int]:
    """First and last time of a recording that only reading it can tell."""
    ends = np.array([chunk.t_us[[0, -1]] for chunk in events.chunks()])
    return int(ends[0, 0]), int(ends[-1, 1])


def best_view(line_map: LineMap, camera: Camera, times_us: IntArray, T_world_camera: SE3) -> View:
    """The view with the greatest length of lines in it."""
    limit = _field_limit(camera)
    # Without the two ends, where the window of events would be cut in half.
    candidates = range(VIEW_STRIDE, len(times_us) - VIEW_STRIDE, VIEW_STRIDE)
    views = (
        _seen_from(line_map, camera, limit, int(times_us[i]), T_world_camera[i]) for i in candidates
    )
    return max(views, key=lambda view: view.seen_length_px)


def _field_limit(camera: Camera) -> FloatArray:
    """(2,) largest normalized |x| and |y| that the image holds, by its border pixels."""
    columns, rows = np.arange(camera.width), np.arange(camera.height)
    border_px = np.concatenate(
        [np.stack([columns, np.full_like(columns, y)], axis=1) for y in (0, camera.height - 1)]
        + [np.stack([np.full_like(rows, x), rows], axis=1) for x in (0, camera.width - 1)]
    )
    xy = normalized_from_pixel(border_px.astype(np.float64), camera.matrix)
    return np.asarray(
        FIELD_MARGIN * np.nanmax(np.abs(undistort(xy, camera.model, camera.distortion)), axis=0)
    )


def _seen_from(
    line_map: LineMap, camera: Camera, limit: FloatArray, t_us: int, T_world_camera: SE3
) -> View:
    segments_camera = T_world_camera.inverse() @ line_map.segments.reshape(-1, 3)
    near_m = NEAR_SHARE * float(np.median(np.linalg.norm(segments_camera, axis=1)))
    clipped = clip_to_depth(segments_camera.reshape(-1, 2, 3), near_m)
    share = np.linspace(0.0, 1.0, PIECE_COUNT + 1)[:, None]
    points = clipped[:, None, 0] * (1.0 - share) + clipped[:, None, 1] * share
    xy = points[..., :2] / points[..., 2:]
    inside = (np.abs(xy) <= limit).all(axis=-1, keepdims=True)
    bent = distort(np.where(inside, xy, np.nan), camera.model, camera.distortion)
    return View(
        t_us=t_us,
        T_world_camera=T_world_camera,
        pixels=pixel_from_normalized(bent, camera.matrix),
        depth_m=points[..., 2],
    )


def event_image(events: EventSource, t_us: int) -> Array:
    """(height, width, 3) RGB in [0, 1]: the events nearest to a moment, by their last polarity."""
    image = np.ones((events.height, events.width, 3))
    start_us, stop_us = t_us - MAX_HALF_WINDOW_US, t_us + MAX_HALF_WINDOW_US
    near = [
        chunk.between(start_us, stop_us)
        for chunk in events.chunks()
        if chunk.t_us[-1] >= start_us and chunk.t_us[0] < stop_us
    ]
    if not near:
        return image
    columns = [
        np.concatenate([getattr(part, name) for part in near]).astype(np.int64)
        for name in ("t_us", "x", "y", "polarity")
    ]
    count = int(EVENTS_PER_PIXEL * events.width * events.height)
    nearest = np.sort(np.argsort(np.abs(columns[0] - t_us), kind="stable")[:count])
    _, x, y, polarity = (column[nearest] for column in columns)
    image[y, x] = np.where(polarity[:, None] > 0, POSITIVE_RGB, NEGATIVE_RGB)
    return image


def _draw_over_events(axes: Axes, view: View, camera: Camera, image: Array) -> Any:
    """Draw the left picture; returns the drawn lines, which carry the colours of depth."""
    from matplotlib.collections import LineCollection

    axes.imshow(image, interpolation="nearest")
    pieces, depth_m = view.pieces
    lines = LineCollection(list(pieces), cmap=DEPTH_COLORS, linewidths=1.6, capstyle="round")
    lines.set_array(depth_m)
    lines.set_clim(*_depth_range_m(depth_m))
    axes.add_collection(lines)
    axes.set_xlim(-0.5, camera.width - 0.5)
    axes.set_ylim(camera.height - 0.5, -0.5)
    axes.set_axis_off()
    return lines


def _depth_range_m(depth_m: FloatArray) -> tuple[float, float]:
    """Range of the colours, blind to a few far lines."""
    if len(depth_m) == 0:
        return 0.0, 1.0
    low, high = np.percentile(depth_m, [2, 95])
    return float(low), float(high)


def _draw_from_above(
    axes: Axes, line_map: LineMap, T_world_camera: SE3, camera: Camera, view: View
) -> None:
    """Draw the right picture: lines in the colours of the left one, those not seen there grey."""
    from matplotlib.collections import LineCollection

    plan = plan_axes(T_world_camera.rotation)
    axes.add_collection(
        LineCollection(
            list(line_map.segments @ plan), colors=UNSEEN_COLOR, linewidths=0.9, capstyle="round"
        )
    )
    seen = view.is_seen
    depth_m = view.depth_m[seen].mean(axis=1)
    lines = LineCollection(
        list(line_map.segments[seen] @ plan),
        cmap=DEPTH_COLORS,
        linewidths=1.6,
        capstyle="round",  # an upright line is a dot from above
        zorder=2,
    )
    lines.set_array(depth_m)
    lines.set_clim(*_depth_range_m(view.pieces[1]))
    axes.add_collection(lines)
    path = T_world_camera.translation @ plan
    axes.plot(*path.T, color=PATH_COLOR, linewidth=1.5, zorder=3)
    _set_extent(axes, np.concatenate([line_map.segments.reshape(-1, 3) @ plan, path]))
    _draw_field_of_view(axes, camera, view, plan)
    _draw_scale_bar(axes)
    axes.set_axis_off()


def plan_axes(R_world_camera: FloatArray) -> FloatArray:
    """(3, 2) world directions that point right and up in a picture seen from above.

    Above is where the cameras' upward direction is on average, or the world axis near to it.
    """
    up = -R_world_camera[:, :, 1].mean(axis=0)
    axis = np.zeros(3)
    axis[np.argmax(np.abs(up))] = np.sign(up[np.argmax(np.abs(up))])
    length = np.linalg.norm(up)
    tilted = length == 0 or up @ axis < math.cos(MAX_TILT_RAD) * length
    up = up / length if tilted and length > 0 else axis
    right = np.eye(3)[np.argmin(np.abs(up))]
    right = right - (right @ up) * up
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(up, right)], axis=1)


def _set_extent(axes: Axes, points: FloatArray) -> None:
    """Show all but the farthest points in a square, with room for the scale bar below."""
    low, high = np.percentile(points, [1, 99], axis=0)
    half = 0.5 * float((high - low).max()) or 1.0
    x, y = (low + high) / 2
    axes.set_xlim(x - 1.1 * half, x + 1.1 * half)
    axes.set_ylim(y - 1.17 * half, y + 1.03 * half)
    axes.set_aspect("equal")


def _draw_field_of_view(axes: Axes, camera: Camera, view: View, plan: FloatArray) -> None:
    """Mark the camera of the left picture: its place and the edges of its view."""
    middle = (camera.height - 1) / 2
    border_px = np.array([[0.0, middle], [camera.width - 1.0, middle]])
    xy = undistort(normalized_from_pixel(border_px, camera.matrix), camera.model, camera.distortion)
    rays = np.concatenate([xy, np.ones((2, 1))], axis=1) @ view.T_world_camera.rotation.T @ plan
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
    centre = view.T_world_camera.translation @ plan
    reach = 0.12 * float(np.diff(axes.get_xlim())[0])
    corners = np.stack([centre + reach * rays[0], centre, centre + reach * rays[1]])
    axes.plot(*corners.T, color="black", linewidth=1.0, zorder=4)
    axes.plot(*centre, "o", color="black", markersize=4, zorder=4)


def _draw_scale_bar(axes: Axes) -> None:
    """A bar of a round length, about a fifth of the picture's width."""
    left, right = axes.get_xlim()
    bottom, top = axes.get_ylim()
    length_m = round_length((right - left) / 5)
    x, y = left + 0.02 * (right - left), bottom + 0.01 * (top - bottom)
    axes.plot([x, x + length_m], [y, y], color="black", linewidth=3, solid_capstyle="butt")
    axes.annotate(f"{length_m:g} m", (x, y), xytext=(0, 5), textcoords="offset points")


def round_length(length: float) -> float:
    """The largest 1, 2 or 5 times a power of ten that is not above."""
    power = 10.0 ** math.floor(math.log10(length))
    return max(step * power for step in (1, 2, 5) if step * power <= length * (1 + 1e-9))
