"""Edges on the walls of a box, a camera that is shaken in it, and the events of the edges alone."""

import functools
from dataclasses import dataclass

import numpy as np

from roel_service.geometry import projection
from roel_service.geometry.se3 import SE3, rotation_from_vector
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventStream
from roel_service.scene.lines import LineMap
from roel_service.scene.trajectory import Trajectory
from roel_service.tracking.fit import View, window_of
from roel_service.tracking.pieces import pieces_of
from roel_service.tracking.sight import Eyes

CAMERA = Camera(width=240, height=180, fx_px=170.0, fy_px=170.0, cx_px=119.5, cy_px=89.5)
STEP_US = 1_000
WINDOW_US = 25_000
NOISE_HZ = 0.5


@dataclass(frozen=True, kw_only=True)
class Recording:
    line_map: LineMap
    trajectory: Trajectory
    events: EventStream

    def pose(self, t_us):
        return self.trajectory.interpolate(np.array([t_us]))[0]

    def chunks(self, size=20_000):
        count = len(self.events)
        return [self.events.part(k, min(k + size, count)) for k in range(0, count, size)]


def walls(seed, line_count=60):
    """(L, 2, 3) m: edges of half a metre to a metre and a half, 2 to 3 m before the camera."""
    rng = np.random.default_rng(seed)
    middle = np.stack(
        [
            rng.uniform(-2.2, 2.2, line_count),
            rng.uniform(-1.6, 1.6, line_count),
            rng.uniform(2.0, 3.2, line_count),
        ],
        axis=-1,
    )
    # Upright, level or slanted, as edges are in rooms.
    directions = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.6, 0.7, 0.4], [-0.7, 0.6, 0.4]])
    along = directions[rng.integers(0, 4, line_count)]
    half_m = 0.5 * rng.uniform(0.4, 1.2, (line_count, 1))
    return np.stack([middle - half_m * along, middle + half_m * along], axis=1)


def motion(t_us):
    """(N) poses of a hand that sways by some centimetres and degrees, at up to 2 Hz."""
    t_s = np.asarray(t_us)[..., None] * 1e-6
    shift_hz, turn_hz = np.array([0.9, 1.3, 0.6]), np.array([1.1, 0.7, 1.7])
    shift_m = np.array([0.12, 0.08, 0.06]) * np.sin(2 * np.pi * shift_hz * t_s + [0.0, 1.0, 2.0])
    turn_rad = np.array([0.05, 0.08, 0.04]) * np.sin(2 * np.pi * turn_hz * t_s + [0.5, 0.0, 1.5])
    return SE3(rotation=rotation_from_vector(turn_rad), translation=shift_m)


@functools.cache
def recording(seed=0, seconds=1.0):
    segments = walls(seed)
    t_us = np.arange(0, round(seconds * 1e6) + STEP_US, STEP_US)
    poses = motion(t_us)
    return Recording(
        line_map=LineMap.from_segments(segments),
        trajectory=Trajectory(t_us=t_us, T_world_camera=poses),
        events=events_of(segments, t_us, poses, np.random.default_rng(seed + 1)),
    )


def events_of(segments, t_us, poses, rng):
    """An event wherever a point of an edge comes over the middle of a pixel, and some noise."""
    share = np.linspace(0.0, 1.0, 160)[:, None]
    along = segments[:, 1] - segments[:, 0]
    points = (segments[:, None, 0] + share * along[:, None]).reshape(-1, 3)
    columns, before = [], None
    for index, time_us in enumerate(t_us):
        seen = projection.project(poses[index].inverse() @ points, CAMERA.matrix)
        seen = np.nan_to_num(seen, nan=-9.0)
        if before is not None:
            noise_count = rng.poisson(NOISE_HZ * CAMERA.width * CAMERA.height * STEP_US * 1e-6)
            noise = rng.integers(0, [CAMERA.width, CAMERA.height], (noise_count, 2))
            xy = np.concatenate([*crossed(before, seen), noise])
            columns.append((np.full(len(xy), time_us), xy))
        before = seen
    xy = np.concatenate([xy for _, xy in columns])
    return EventStream(
        t_us=np.concatenate([t for t, _ in columns]),
        x=xy[:, 0],
        y=xy[:, 1],
        polarity=np.ones(len(xy), np.int8),
        width=CAMERA.width,
        height=CAMERA.height,
    )


def crossed(before, after):
    """For each axis, (n, 2) pixels whose middles points came over between two moments."""
    for axis in (0, 1):
        first, last = np.floor(before[:, axis]), np.floor(after[:, axis])
        pixel = np.rint(after)
        pixel[:, axis] = np.maximum(first, last)
        inside = (pixel >= 0).all(axis=1) & (pixel < [CAMERA.width, CAMERA.height]).all(axis=1)
        yield np.unique(pixel[inside & (first != last)].astype(np.int64), axis=0)


def eyes_on(line_map):
    return Eyes(
        camera=CAMERA,
        ideal_px=projection.undistortion_table(CAMERA),
        view=View(K=CAMERA.matrix, width=CAMERA.width, height=CAMERA.height),
        pieces=pieces_of(line_map),
    )


def window_at(t_us, events, most=8_000):
    """The events of one interval around a time."""
    span_us = (t_us - WINDOW_US // 2, t_us + WINDOW_US // 2)
    start, stop = np.searchsorted(events.t_us, span_us)
    ideal_px = projection.undistortion_table(CAMERA)
    return window_of(events.slice(int(start), int(stop), t_us), ideal_px, span_us, most)


def result_of(slices):
    """What a work in slices returns, all of them done."""
    while True:
        try:
            next(slices)
        except StopIteration as end:
            return end.value
