"""Scenes and rows that are known on paper."""

from __future__ import annotations

import numpy as np

from roel_bench.results import NO_DISTURBANCE, Row
from roel_bench.scenes import MapTruth, Scene
from roel_bench.suites import current_digest
from roel_service.geometry.se3 import SE3
from roel_service.scene.camera import Camera
from roel_service.scene.clouds import PointCloud, TriangleMesh
from roel_service.scene.events import EventStream
from roel_service.scene.trajectory import Trajectory

WIDTH, HEIGHT = 64, 48
CAMERA = Camera(width=WIDTH, height=HEIGHT, fx_px=60.0, fy_px=60.0, cx_px=31.5, cy_px=23.5)
AT_ORIGIN = SE3(rotation=np.eye(3), translation=np.zeros(3))


def quad(corners):
    """Two triangles of four corners in their order."""
    corners = np.array(corners, dtype=np.float32)
    return corners[[[0, 1, 2], [0, 2, 3]]]


def square(side_m, z_m):
    """A square normal to the optical axis."""
    h = side_m / 2
    return quad([[-h, -h, z_m], [h, -h, z_m], [h, h, z_m], [-h, h, z_m]])


def truth(triangles, edges):
    return MapTruth(
        mesh=TriangleMesh(triangles=triangles), edges=PointCloud(points=np.array(edges))
    )


def random_events(count=1000, duration_us=100_000, seed=0):
    rng = np.random.default_rng(seed)
    return EventStream(
        t_us=np.sort(rng.integers(0, duration_us, count)),
        x=rng.integers(0, WIDTH, count),
        y=rng.integers(0, HEIGHT, count),
        polarity=rng.choice([-1, 1], count),
        width=WIDTH,
        height=HEIGHT,
    )


def moving_camera(duration_us=100_000, step_us=5_000, speed_m_per_s=1.0):
    """Poses that move along x, without rotation."""
    t_us = np.arange(0, duration_us + 1, step_us)
    translation = np.zeros((len(t_us), 3))
    translation[:, 0] = speed_m_per_s * t_us * 1e-6
    rotation = np.broadcast_to(np.eye(3), (len(t_us), 3, 3))
    return Trajectory(t_us=t_us, T_world_camera=SE3(rotation=rotation, translation=translation))


def scene(**changes):
    given = {
        "name": "sample",
        "events": random_events(),
        "camera": CAMERA,
        "trajectory": moving_camera(),
    }
    return Scene(**(given | changes))


def row(scene="sim_201_640x480_8s", method="default", **changes):
    figures = changes.pop("figures", {})
    task = changes.pop("task", "map")
    given = {
        "task": task,
        "scene": scene,
        "sensor": scene.split("_")[2] if scene.startswith("sim") else "640x480",
        "is_tuning": False,
        "disturbance": NO_DISTURBANCE,
        "method": method,
        "config_digest": current_digest(task, method),
        "figures": figures,
        "seconds": {"detect": 1.0, "refine": 1.0},
        "frame_count": 20,
        "event_count": 1000,
        "peak_rss_mib": 100.0,
    }
    return Row(**(given | changes))
