"""A small recording whose lines are known: bars in front of a camera that slides past them."""

import numpy as np

from roel_service.geometry.se3 import SE3
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventStream
from roel_service.scene.trajectory import Trajectory

CAMERA = Camera(width=160, height=120, fx_px=120.0, fy_px=120.0, cx_px=80.0, cy_px=60.0)

# Ends of the bars: a frame, and a cross and two posts nearer to the camera, m.
BARS = np.array(
    [
        [[-0.9, -0.6, 2.0], [0.7, -0.65, 2.0]],
        [[0.7, -0.65, 2.0], [0.8, 0.6, 2.1]],
        [[0.8, 0.6, 2.1], [-0.8, 0.7, 2.0]],
        [[-0.8, 0.7, 2.0], [-0.9, -0.6, 2.0]],
        [[-0.4, -0.3, 1.5], [0.35, 0.3, 1.6]],
        [[-0.3, 0.35, 1.6], [0.3, -0.3, 1.5]],
        [[-0.6, -0.5, 1.8], [-0.55, 0.5, 1.8]],
        [[0.5, -0.5, 1.7], [0.45, 0.5, 1.7]],
    ]
)
DURATION_US = 1_000_000
STEP_US = 1000


def trajectory():
    """A slide along x and y, without rotation."""
    t_us = np.arange(0, DURATION_US + 1, 5000)
    return Trajectory(
        t_us=t_us,
        T_world_camera=SE3(
            rotation=np.tile(np.eye(3), (len(t_us), 1, 1)), translation=_positions(t_us)
        ),
    )


def events():
    """An event wherever a bar enters (+1) or leaves (-1) a pixel."""
    times_us = np.arange(STEP_US, DURATION_US, STEP_US)
    seen = _pixels(0)
    batches = []
    for t_us in times_us:
        now = _pixels(t_us)
        for pixels, polarity in ((now - seen, 1), (seen - now, -1)):
            batches += [(t_us, x, y, polarity) for x, y in sorted(pixels)]
        seen = now
    t, x, y, polarity = np.array(batches).T
    return EventStream(
        t_us=t,
        x=x.astype(np.uint16),
        y=y.astype(np.uint16),
        polarity=polarity.astype(np.int8),
        width=CAMERA.width,
        height=CAMERA.height,
    )


def _positions(t_us):
    share = np.atleast_1d(t_us) / DURATION_US
    return np.stack([0.4 * share - 0.2, 0.3 * share - 0.15, np.zeros_like(share)], axis=1)


def _pixels(t_us):
    """The pixels that a bar covers."""
    share = np.linspace(0.0, 1.0, 400)[:, None]
    points = np.concatenate([start + share * (end - start) for start, end in BARS])
    points = points - _positions(t_us)
    x = np.round(CAMERA.fx_px * points[:, 0] / points[:, 2] + CAMERA.cx_px).astype(int)
    y = np.round(CAMERA.fy_px * points[:, 1] / points[:, 2] + CAMERA.cy_px).astype(int)
    inside = (x >= 0) & (x < CAMERA.width) & (y >= 0) & (y < CAMERA.height)
    return set(zip(x[inside].tolist(), y[inside].tolist(), strict=True))
