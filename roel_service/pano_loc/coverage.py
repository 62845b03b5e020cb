"""How much of a picture a map explains at a pose, and how much of the map the picture shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roel_service.arrays import Array, FloatArray, IntArray
from roel_service.geometry.se3 import SE3
from roel_service.geometry.vectors import dot, norm, unit
from roel_service.pano_loc import refine_kernels
from roel_service.pano_loc.arcs import PanoramaArcs

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


@dataclass(frozen=True, eq=False, kw_only=True)
class LinePoints:
    """Points of a map's lines, in the middles of equal parts.

    Attributes:
        points: (P, 3) m; those of line j are offsets[j]:offsets[j + 1].
        offsets: (L + 1,).
        length_m: (P,) that each stands for.
        directions: (L, 3) unit.
    """

    points: FloatArray
    offsets: IntArray
    length_m: FloatArray
    directions: FloatArray

    @staticmethod
    def of(segments: FloatArray, spacing_m: float) -> LinePoints:
        """Of (L, 2, 3) m, at most so far apart; every line has one."""
        span = segments[:, 1] - segments[:, 0]
        length_m, directions = norm(span), unit(span)
        counts = np.maximum(np.ceil(length_m / spacing_m), 1).astype(np.int64)
        offsets = np.concatenate([[0], np.cumsum(counts)])
        line = np.repeat(np.arange(len(counts)), counts)
        along_m = (np.arange(len(line)) - offsets[line] + 0.5) * (length_m / counts)[line]
        points = segments[line, 0] + along_m[:, None] * directions[line]
        return LinePoints(
            points=points,
            offsets=offsets,
            length_m=(length_m / counts)[line],
            directions=directions,
        )


def covered(pose: SE3, arcs: PanoramaArcs, lines: LinePoints) -> float:
    """Share of the map's lines, by the angle that they take up, on which arcs lie; 0 to 1."""
    offset = (lines.points - pose.translation) @ pose.rotation
    distance_m = np.maximum(norm(offset), refine_kernels.MIN_DISTANCE_M)
    rays = offset / distance_m[:, None]
    directions = lines.directions @ pose.rotation
    off, crowd = refine_kernels.match_points(
        rays,
        lines.offsets,
        directions,
        arcs.normals,
        np.cross(arcs.normals, arcs.starts),
        np.cross(arcs.ends, arcs.normals),
        GATE_RAD,
        CROWD_REACH_RAD,
    )
    along = dot(rays, np.repeat(directions, np.diff(lines.offsets), axis=0))
    weight = lines.length_m * np.sqrt(np.maximum(0.0, 1.0 - along**2)) / distance_m
    if len(arcs.sides):
        weight *= (rays @ arcs.sides.T > 0.0).all(axis=1)
    return float(weight @ credit(off, crowd) / max(weight.sum(), 1e-9))
