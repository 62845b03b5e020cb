"""What the first push of a process would wait for, done before events come."""

from __future__ import annotations

from functools import cache

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.config.stages import TrackConfig
from roel_service.geometry.se3 import SE3
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventStream, concatenate
from roel_service.scene.lines import LineMap
from roel_service.tracking.tracker import PoseTracker

CAMERA = Camera(width=160, height=120, fx_px=120.0, fy_px=120.0, cx_px=79.5, cy_px=59.5)
# Bars on a wall, and how fast they pass.
DEPTH_M = 2.0
UPRIGHT_PX, LEVEL_PX = (11.3, 37.8, 58.1, 92.6, 121.4, 149.7), (14.2, 33.9, 61.5, 77.3, 104.8)
SPEED_PX_MS = np.array([0.23, 0.17])
DURATION_MS = 100


@cache  # once in a process
def warm_up() -> None:
    """Load all loops that a tracker runs; the first time on a machine they are compiled.

    A camera that passes a wall with bars is looked for and followed.
    """
    bars_px = np.array(
        [[[x, 0.0], [x, 119.0]] for x in UPRIGHT_PX] + [[[0.0, y], [159.0, y]] for y in LEVEL_PX]
    )
    rays = np.concatenate([(bars_px - CAMERA.matrix[:2, 2]) / CAMERA.fx_px, np.ones((11, 2, 1))], 2)
    tracker = PoseTracker(
        LineMap.from_segments(DEPTH_M * rays), CAMERA, TrackConfig(), SE3.identity(), is_live=False
    )
    for t_ms in range(0, DURATION_MS, 25):
        tracker.push(concatenate([_events(bars_px, t_ms + after) for after in range(25)]))


def _events(bars_px: FloatArray, t_ms: int) -> EventStream:
    """An event wherever a point of a bar came into another pixel in a millisecond."""
    share = np.linspace(0.0, 1.0, 160)[:, None]
    points = bars_px[:, :1] + share * (bars_px[:, 1:] - bars_px[:, :1])
    # They come and go, and do not leave the picture.
    moved = points.reshape(-1, 2) + SPEED_PX_MS * abs(t_ms % 100 - 50)
    before = np.floor(moved - SPEED_PX_MS)
    xy = np.floor(moved)
    inside = (xy >= 0).all(axis=1) & (xy < [CAMERA.width, CAMERA.height]).all(axis=1)
    xy = np.unique(xy[inside & (xy != before).any(axis=1)].astype(np.int64), axis=0)
    return EventStream(
        t_us=np.full(len(xy), 1_000 * t_ms),
        x=xy[:, 0],
        y=xy[:, 1],
        polarity=np.ones(len(xy), np.int8),
        width=CAMERA.width,
        height=CAMERA.height,
    )
