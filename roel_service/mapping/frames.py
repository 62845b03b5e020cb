"""Event frames at regular times: windows of events, brought to the frame's time.

Paper: "Multi-window, Multi-representation Line Detection"; frames are made at fixed intervals.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from roel_service.arrays import Array, FloatArray, IntArray
from roel_service.config.stages import DetectConfig, FramesConfig
from roel_service.geometry.se3 import SE3, vector_from_rotation
from roel_service.mapping import frames_kernels
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventSlice, EventStream, concatenate
from roel_service.scene.trajectory import Trajectory

# Polarity label of what both polarities show.
UNKNOWN_POLARITY = 0
# Half of the time step over which the camera's velocity is measured.
VELOCITY_HALF_STEP_US = 5_000


@dataclass(frozen=True, eq=False, kw_only=True)
class Frames:
    """Times and poses of all frames, in ideal pinhole pixels.

    Attributes:
        t_us: (N,) int64, increasing.
        T_world_camera: (N) poses.
        K: (3, 3) calibration matrix, px.
        width, height: px.
    """

    t_us: IntArray
    T_world_camera: SE3
    K: FloatArray
    width: int
    height: int

    def __len__(self) -> int:
        return len(self.t_us)

    @property
    def focal_px(self) -> float:
        return float(np.sqrt(self.K[0, 0] * self.K[1, 1]))


@dataclass(frozen=True, eq=False, kw_only=True)
class EventFrame:
    """The events around one time.

    Attributes:
        events: the largest window; t_ref_us is the frame's time. Those of one time are in the
            order of their pixels, whatever order they came in.
        ideal_px: (K, 2) float32, undistorted, at each event's own time.
        compensated_px: (K, 2) float32, with the camera's rotation undone.
        windows: for each configured window its half-open range of `events`, smallest first.
        width, height: px.
    """

    events: EventSlice
    ideal_px: Array
    compensated_px: Array
    windows: tuple[tuple[int, int], ...]
    width: int
    height: int


def velocities(frames: Frames, trajectory: Trajectory) -> FloatArray:
    """(N, 3) camera velocity at each frame, m/s, world."""
    before, after, step_s = _around(frames, trajectory)
    return (after.translation - before.translation) / step_s


def turn_rates(frames: Frames, trajectory: Trajectory) -> FloatArray:
    """(N, 3) angular velocity of the camera at each frame, rad/s, in its own frame."""
    before, after, step_s = _around(frames, trajectory)
    turn = np.swapaxes(before.rotation, -1, -2) @ after.rotation
    return np.asarray(vector_from_rotation(turn) / step_s)


def _around(frames: Frames, trajectory: Trajectory) -> tuple[SE3, SE3, FloatArray]:
    """(N) poses just before and just after each frame, and the (N, 1) seconds between them."""
    limits = trajectory.t_us[[0, -1]]
    before_us = np.clip(frames.t_us - VELOCITY_HALF_STEP_US, *limits)
    after_us = np.clip(frames.t_us + VELOCITY_HALF_STEP_US, *limits)
    before, after = trajectory.interpolate(before_us), trajectory.interpolate(after_us)
    step_s = np.asarray((after_us - before_us) * 1e-6, dtype=np.float64)
    return before, after, step_s[:, None]


def frame_times(
    trajectory: Trajectory, range_us: tuple[int, int] | None, config: FramesConfig
) -> list[int]:
    """Times, in us, at which lines are looked for.

    They are `rate_hz` apart, or closer where a short recording would give less than
    `min_frame_count` of them. The longest window around each lies within the poses.

    Args:
        trajectory: poses.
        range_us: first and last event; None where unknown: the poses' range, at `rate_hz`.
        config: rate, least number and longest window.
    """
    limits_us = range_us or (int(trajectory.t_us[0]), int(trajectory.t_us[-1]))
    inside = _inside_us(trajectory, limits_us, config)
    interval_us = 1e6 / config.rate_hz
    if range_us is not None:
        duration_us = float(np.diff(inside).sum())
        interval_us = min(interval_us, duration_us / config.min_frame_count)
    return _times_us(inside, interval_us)


def frame_times_so_far(
    trajectory: Trajectory, range_us: tuple[int, int], config: FramesConfig
) -> list[int]:
    """Times of `frame_times` that are certain while a recording goes on.

    They are the first ones of the whole recording, unless it ends so soon that they have to lie
    closer together.
    """
    return _times_us(_inside_us(trajectory, range_us, config), 1e6 / config.rate_hz)


def _inside_us(
    trajectory: Trajectory, limits_us: tuple[int, int], config: FramesConfig
) -> IntArray:
    """(n, 2) spans of times around which the longest window lies within events and poses."""
    reach_us = config.max_half_window_us
    inside = np.clip(trajectory.covered_us(), *limits_us) + np.array([reach_us, -reach_us])
    return np.asarray(inside[inside[:, 0] <= inside[:, 1]])


def _times_us(spans_us: IntArray, interval_us: float) -> list[int]:
    step_us = max(1, round(interval_us))
    return [t_us for first, last in spans_us.tolist() for t_us in range(first, last + 1, step_us)]


def frame_slices(
    chunks: Iterable[EventStream], times_us: list[int], reach_us: int
) -> Iterator[tuple[int, EventStream]]:
    """The events around each time, read once and front to back.

    Memory holds one chunk and one window, however long the recording is.

    Args:
        chunks: events in the order of time.
        times_us: ascending; those later than the last event are passed over.
        reach_us: events this close to a time belong to it.

    Yields:
        (t_us, a stream that holds the events within `reach_us` of it).
    """
    waiting = deque(times_us)
    buffer: EventStream | None = None
    for chunk in chunks:
        if len(chunk) == 0 or not waiting:
            continue
        buffer = extended(buffer, chunk, keep_from_us=waiting[0] - reach_us)
        while waiting and waiting[0] + reach_us <= buffer.t_us[-1]:
            yield waiting.popleft(), buffer


def extended(buffer: EventStream | None, chunk: EventStream, *, keep_from_us: int) -> EventStream:
    """The events of a buffer from a time on, and those of the next chunk."""
    if buffer is None:
        return chunk
    first = int(np.searchsorted(buffer.t_us, keep_from_us))
    return concatenate([buffer.part(first, len(buffer)), chunk])


def event_frame(
    events: EventStream,
    t_us: int,
    ideal_px: Array,
    trajectory: Trajectory,
    camera: Camera,
    frames: FramesConfig,
    detect: DetectConfig,
) -> EventFrame:
    """The windows of one frame, undistorted and with the camera's rotation undone.

    Args:
        events: a stream that covers the longest window.
        t_us: time of the frame.
        ideal_px: (H, W, 2) float32 undistortion table of the camera.
        trajectory, camera: poses over the window and calibration.
        frames, detect: their tables of the configuration.
    """
    counts = window_event_counts(detect, camera.width * camera.height)
    ranges = [window_range(events.t_us, t_us, count, frames) for count in counts]
    start = min(first for first, _ in ranges)
    stop = max(last for _, last in ranges)
    largest = _in_fixed_order(events.slice(start, stop, t_us))
    own_px = _looked_up(ideal_px, largest)
    compensated_px = own_px
    if frames.compensate_rotation and len(largest):
        compensated_px = _compensated(largest, ideal_px, trajectory, camera.matrix, frames.slot_us)
    return EventFrame(
        events=largest,
        ideal_px=own_px,
        compensated_px=compensated_px,
        windows=tuple((first - start, last - start) for first, last in ranges),
        width=camera.width,
        height=camera.height,
    )


def _looked_up(ideal_px: Array, events: EventSlice) -> Array:
    """(K, 2) float32 entries of an (H, W, 2) table; of rows, `take` is ten times as fast."""
    place = events.y.astype(np.intp) * ideal_px.shape[1] + events.x
    return np.asarray(ideal_px.reshape(-1, 2).take(place, axis=0))


def window_event_counts(config: DetectConfig, pixel_count: int) -> tuple[int, ...]:
    """Events of each window, smallest first."""
    counts = config.window_event_counts or tuple(
        round(density * pixel_count) for density in config.window_events_per_pixel
    )
    return tuple(sorted(max(1, count) for count in counts))


def window_range(
    t_us: IntArray, centre_us: int, count: int, config: FramesConfig
) -> tuple[int, int]:
    """Half-open index range of about `count` events, half of them on each side of a time.

    The window is never shorter than `min_half_window_us` nor longer than `max_half_window_us` on
    either side, and holds all events of a time or none.
    """
    middle = int(np.searchsorted(t_us, centre_us))
    reach = [config.max_half_window_us, config.min_half_window_us]
    low_max, low_min = np.searchsorted(t_us, [centre_us - r for r in reach])
    high_max, high_min = np.searchsorted(t_us, [centre_us + r for r in reach])
    start = min(max(middle - count // 2, int(low_max)), int(low_min))
    stop = max(min(middle + count // 2, int(high_max)), int(high_min))
    if start < stop:
        start = int(np.searchsorted(t_us, t_us[start]))
        stop = int(np.searchsorted(t_us, t_us[stop - 1], side="right"))
    return start, stop


def _in_fixed_order(events: EventSlice) -> EventSlice:
    """The same events; those of one time by row, column and polarity."""
    order = frames_kernels.fixed_order(events.t_us, events.x, events.y, events.polarity)
    return EventSlice(
        t_us=events.t_us,
        x=events.x[order],
        y=events.y[order],
        polarity=events.polarity[order],
        t_ref_us=events.t_ref_us,
    )


def _compensated(
    events: EventSlice, ideal_px: Array, trajectory: Trajectory, K: FloatArray, slot_us: int
) -> Array:
    """(K, 2) float32 pixels x' ~ K R_i^T R(t) K^-1 x; exact for rotation, at any depth."""
    first_us = int(events.t_us[0])
    slot_count = (int(events.t_us[-1]) - first_us) // slot_us + 1
    middles_us = first_us + np.arange(slot_count) * slot_us + slot_us // 2
    middles_us = np.clip(middles_us, trajectory.t_us[0], trajectory.t_us[-1])
    R_world_slot = trajectory.interpolate(middles_us).rotation
    R_world_frame = trajectory.interpolate(np.array([events.t_ref_us])).rotation[0]
    homographies = K @ R_world_frame.T @ R_world_slot @ np.linalg.inv(K)
    compensated_px = np.empty((len(events), 2), np.float32)
    frames_kernels.compensate(
        events.t_us, events.x, events.y, ideal_px, first_us, slot_us, homographies, compensated_px
    )
    return compensated_px


def frames_at(t_us: IntArray, trajectory: Trajectory, camera: Camera) -> Frames:
    """Times and poses of the frames that were looked at."""
    return Frames(
        t_us=t_us,
        T_world_camera=trajectory.interpolate(t_us),
        K=camera.matrix,
        width=camera.width,
        height=camera.height,
    )
