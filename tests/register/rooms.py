"""A furnished room of boxes: its line map, and a noisy cloud of its surfaces."""

from __future__ import annotations

import numpy as np

from roel_service.scene.clouds import PointCloud, TriangleMesh
from roel_service.scene.lines import LineMap

# Two corners of every box, m: the room itself, then a table, a cupboard, a chest and a shelf.
ROOM = ((0.0, 0.0, 0.0), (4.0, 3.2, 2.5))
FURNITURE = (
    ((0.6, 0.5, 0.0), (1.9, 1.2, 0.75)),
    ((3.4, 0.0, 0.0), (4.0, 1.1, 2.0)),
    ((2.3, 2.6, 0.0), (3.5, 3.2, 0.9)),
    ((0.0, 1.9, 1.3), (0.3, 2.9, 1.7)),
)
BOXES = (ROOM, *FURNITURE)


def corners(box):
    low, high = np.asarray(box)
    bits = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)])
    return low + bits * (high - low)


def edges(box):
    """(12, 2, 3) edges of a box."""
    pairs = [(a, a | 1 << bit) for a in range(8) for bit in range(3) if not a >> bit & 1]
    return corners(box)[np.array(pairs)]


def triangles(box):
    """(12, 3, 3) surface of a box."""
    faces = [(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5)]
    p = corners(box)
    return np.concatenate([[p[[a, b, c]], p[[a, c, d]]] for a, b, c, d in faces])


def room_mesh(boxes=BOXES):
    return TriangleMesh(triangles=np.concatenate([triangles(box) for box in boxes]))


def room_cloud(boxes=BOXES, *, count=60_000, noise_m=0.003, seed=0):
    rng = np.random.default_rng(seed)
    cloud = room_mesh(boxes).sampled(count, rng)
    return PointCloud(points=cloud.points + rng.normal(0.0, noise_m, (count, 3)))


def room_map(boxes=BOXES, *, noise_m=0.003, seed=1):
    """Every edge, cut a little at both ends and moved a little."""
    rng = np.random.default_rng(seed)
    segments = np.concatenate([edges(box) for box in boxes])
    along = segments[:, 1] - segments[:, 0]
    cut = rng.uniform(0.0, 0.2, (len(segments), 2, 1)) * [[[1.0], [-1.0]]]
    segments = segments + cut * along[:, None] + rng.normal(0.0, noise_m, segments.shape)
    return LineMap(
        segments=segments,
        observation_count=np.full(len(segments), 30, np.int32),
        rms_residual_px=np.full(len(segments), 0.3, np.float32),
        sigma_m=np.full(len(segments), 0.01, np.float32),
    )
