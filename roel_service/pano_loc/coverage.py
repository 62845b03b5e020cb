"""How much of a picture a map explains at a pose, and how much of the map the picture shows."""

from __future__ import annotations

import numpy as np

from roel_service.arrays import Array, FloatArray
from roel_service.geometry.se3 import SE3
from roel_service.geometry.vectors import norm, unit
from roel_service.pano_loc import sight_kernels
from roel_service.pano_loc.sight_kernels import LinePoints, Samples

# Arcs must have a line's direction within the gate; the width is that of the kernel.
GATE_RAD, WIDTH_RAD = np.deg2rad(6.0), np.deg2rad(0.7)
# Where lines crowd, some lie on anything: others are counted so far to both sides of a match, which
# counts by this power of the chance that none of so many would have come as close.
CROWD_REACH_RAD, CROWD_POWER = np.deg2rad(8.0), 4.0
# Map lines may be hidden: their share counts a quarter.
COVERAGE_WEIGHT = 0.25


def credit(off: FloatArray, crowd: Array) -> FloatArray:
    """0 to 1, what matches count.

    Args:
        off: sines of the angles to the nearest line, which may be infinite.
        crowd: lines within `CROWD_REACH_RAD`, this one too.
    """
    off = np.minimum(off, 1.0)
    others = np.maximum(crowd - 1, 0)
    return np.asarray(
        np.exp(-0.5 * (off / WIDTH_RAD) ** 2 - CROWD_POWER * others * off / CROWD_REACH_RAD)
    )


def two_way_score(explained_2d: float, explained_3d: float) -> float:
    """0 to 1, of the share of the arcs that the map explains and that of the map that they show."""
    return (explained_2d + COVERAGE_WEIGHT * explained_3d) / (1.0 + COVERAGE_WEIGHT)


def line_points(segments: FloatArray, spacing_m: float) -> LinePoints:
    """Of (L, 2, 3) m, at most so far apart; every line has one."""
    span = segments[:, 1] - segments[:, 0]
    length_m, directions = norm(span), unit(span)
    counts = np.maximum(np.ceil(length_m / spacing_m), 1).astype(np.int64)
    offsets = np.concatenate([[0], np.cumsum(counts)])
    line = np.repeat(np.arange(len(counts)), counts)
    along_m = (np.arange(len(line)) - offsets[line] + 0.5) * (length_m / counts)[line]
    return LinePoints(
        points=segments[line, 0] + along_m[:, None] * directions[line],
        offsets=offsets,
        length_m=(length_m / counts)[line],
        directions=directions,
    )


def covered(pose: SE3, samples: Samples, sides: FloatArray, lines: LinePoints) -> float:
    """Share of the map's lines, by the angle that they take up, on which arcs lie; 0 to 1.

    Args:
        pose: T_world_picture.
        samples: of the arcs.
        sides: (V, 3) of the picture, as `PanoramaArcs` has them.
        lines: of the map.
    """
    rays, weight, off, crowd = sight_kernels.match_points(
        lines, pose.rotation, pose.translation, samples, GATE_RAD, CROWD_REACH_RAD
    )
    if len(sides):
        weight *= (rays @ sides.T > 0.0).all(axis=1)
    return float(weight @ credit(off, crowd) / max(weight.sum(), 1e-9))
