"""Wireframe rooms, and what a panorama would show of them."""

from __future__ import annotations

import numpy as np

from roel_service.geometry.se3 import SE3, rotation_from_vector
from roel_service.geometry.vectors import unit
from roel_service.pano_loc.arcs import PanoramaArcs
from roel_service.scene.lines import LineMap
from tests.register.rooms import ROOM, edges

# Furniture against the walls, so that the middle is free.
FURNITURE = (
    ((0.1, 0.5, 0.0), (0.8, 1.7, 0.75)),
    ((3.4, 0.0, 0.0), (4.0, 1.1, 2.0)),
    ((2.3, 2.6, 0.0), (3.5, 3.2, 0.9)),
    ((0.0, 1.9, 1.3), (0.3, 2.9, 1.7)),
    ((1.2, 0.0, 1.1), (2.2, 0.05, 1.9)),
    ((1.0, 3.15, 0.0), (1.9, 3.2, 2.05)),
    ((3.95, 1.6, 1.0), (4.0, 2.5, 1.6)),
)
OTHER_ROOM = ((0.0, 0.0, 0.0), (5.1, 2.4, 2.8))
OTHER_FURNITURE = (
    ((0.0, 0.3, 0.0), (0.5, 2.0, 1.8)),
    ((1.4, 1.9, 0.0), (2.9, 2.4, 0.45)),
    ((3.6, 0.0, 0.9), (4.9, 0.1, 2.1)),
    ((5.0, 0.8, 0.0), (5.1, 1.7, 2.1)),
    ((2.0, 0.0, 0.0), (2.4, 0.4, 1.2)),
    ((0.7, 2.35, 1.2), (1.2, 2.4, 1.9)),
)
# The middle and the faces of the room alone: equal to itself after half a turn.
SYMMETRIC_FURNITURE = (
    ((0.0, 1.1, 0.0), (0.05, 2.1, 2.0)),
    ((3.95, 1.1, 0.0), (4.0, 2.1, 2.0)),
    ((1.5, 0.0, 1.0), (2.5, 0.05, 1.8)),
    ((1.5, 3.15, 1.0), (2.5, 3.2, 1.8)),
)


def segments_of(room=ROOM, furniture=FURNITURE):
    """(L, 2, 3) m."""
    return np.concatenate([edges(box) for box in (room, *furniture)])


def map_of(room=ROOM, furniture=FURNITURE, *, noise_m=0.0):
    segments = segments_of(room, furniture)
    noise = np.random.default_rng(0).normal(0.0, noise_m, segments.shape)
    return LineMap.from_segments(segments + noise)


def pose(x_m, y_m, z_m, *turn_rad):
    return SE3(
        rotation=rotation_from_vector(np.array(turn_rad)), translation=np.array([x_m, y_m, z_m])
    )


def seen_from(T_world_panorama, segments, *, noise_rad=0.0, seed=0):
    """Arcs of all segments; nothing hides another."""
    rays = T_world_panorama.inverse() @ segments
    noise = np.random.default_rng(seed).normal(0.0, noise_rad, rays.shape)
    rays = unit(unit(rays) + noise)
    return PanoramaArcs.between(rays[:, 0], rays[:, 1])
