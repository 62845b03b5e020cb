"""Scenes whose pictures and edges are known on paper."""

from __future__ import annotations

import numpy as np

from roel_service.geometry.se3 import SE3
from roel_service.simulate import textures
from roel_service.simulate.rooms import SceneBuilder
from roel_service.simulate.scenes import Scene

WIDTH, HEIGHT = 64, 48
FOCAL_PX = 60.0
K = np.array([[FOCAL_PX, 0.0, (WIDTH - 1) / 2], [0.0, FOCAL_PX, (HEIGHT - 1) / 2], [0.0, 0.0, 1.0]])
DEPTH_M = 2.0
DARK, BRIGHT = 0.3, 0.6


def wall_with_edge(normal: np.ndarray, dark: float = DARK, bright: float = BRIGHT) -> Scene:
    """A wall at z = DEPTH_M with camera axes, dark where normal . (x, y) < 0, else bright."""
    along = np.array([-normal[1], normal[0], 0.0])
    across = np.append(normal, 0.0)
    foot = np.array([0.0, 0.0, DEPTH_M])
    build = SceneBuilder()
    for side, grey in ((-1.0, dark), (1.0, bright)):
        reach = side * across * 20.0
        corners = [foot - 20 * along, foot - 20 * along + reach, foot + 20 * along + reach]
        wall = np.array([*corners, foot + 20 * along])
        build.quad(wall, build.texture(textures.plain(np.full(3, grey))))
    return unlit(build.scene())


def unlit(scene: Scene) -> Scene:
    """The same scene, as bright as its textures everywhere."""
    return Scene(
        triangles=scene.triangles,
        uv=scene.uv,
        texture=scene.texture,
        brightness=np.ones(len(scene.triangles), np.float32),
        textures=scene.textures,
        background=scene.background,
    )


def at(*translation: float) -> SE3:
    """A camera with the axes of the world."""
    return SE3(rotation=np.eye(3), translation=np.array(translation))
