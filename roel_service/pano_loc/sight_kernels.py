"""Lines of a map as seen at one pose, and the arcs of a picture that may be theirs.

Everything is in the picture's frame: lines are turned into it once for each pose, and the arcs stay
as they are. Rays of an arc are cos t middle + sin t aside, so that what a ray has in common with a
line is found once for the arc.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from roel_service.arrays import Array, FloatArray, IntArray

# Lines whose viewing plane is not defined, or closer to the centre than this, are left out, m.
MIN_DISTANCE_M = 0.05
# A ray belongs to a line's image up to this far beyond its ends.
END_SLACK_RAD = np.deg2rad(1.5)
END_SLACK_SINE = np.sin(END_SLACK_RAD)
# Viewing planes of arc and line differ by no more than this, or the arc's own error if larger.
MIN_NORMAL_GATE_RAD = np.deg2rad(15.0)


class Sight(NamedTuple):
    """Lines from a pose; a tuple, as compiled loops take it whole.

    Attributes:
        normals: (L, 3) unit, of the planes of centre and line; zero for lines without one.
        moments_m2: (L,) lengths of start x end.
        directions: (L, 3) unit.
        spans: (L, 3) start - end, m.
        from_start, to_end: (L, 3) unit, normal x start and end x normal: into the line's image.
    """

    normals: FloatArray
    moments_m2: FloatArray
    directions: FloatArray
    spans: FloatArray
    from_start: FloatArray
    to_end: FloatArray


class Samples(NamedTuple):
    """Arcs, and rays along them at about equal angles; a tuple for the same reason.

    Attributes:
        normals, middles, asides: (A, 3) unit; aside is normal x middle.
        columns: (8, A) float32: normals and middles by coordinate, cosine and sine of half the
            arcs' lengths; so that one instruction takes several arcs.
        reach_rad: (A,) half the arcs' lengths.
        offsets: (A + 1,); rays of arc a are offsets[a]:offsets[a + 1].
        cosine, sine: (S,) of the angle from the middle to each ray.
        weight: (S,) angle that each ray stands for, rad.
    """

    normals: FloatArray
    middles: FloatArray
    asides: FloatArray
    columns: Array
    reach_rad: FloatArray
    offsets: IntArray
    cosine: FloatArray
    sine: FloatArray
    weight: FloatArray


class LinePoints(NamedTuple):
    """Points of a map's lines, in the middles of equal parts.

    Attributes:
        points: (P, 3) m, world; those of line j are offsets[j]:offsets[j + 1].
        offsets: (L + 1,).
        length_m: (P,) that each stands for.
        directions: (L, 3) unit.
    """

    points: FloatArray
    offsets: IntArray
    length_m: FloatArray
    directions: FloatArray


class Pairs(NamedTuple):
    """(P,) lines and arcs that may be one another's."""

    line: IntArray
    arc: IntArray


@numba.njit(cache=True, nogil=True, inline="always")
def dot(a: FloatArray, b: FloatArray) -> float:
    """Of (3,) vectors."""
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


@numba.njit(cache=True, nogil=True, inline="always")
def _dots(a: FloatArray, i: int, b: FloatArray, j: int) -> float:
    """Of a[i] and b[j], which would be counted as references if they were named."""
    return float(a[i, 0] * b[j, 0] + a[i, 1] * b[j, 1] + a[i, 2] * b[j, 2])


@numba.njit(cache=True, nogil=True, inline="always")
def _cross_into(a: FloatArray, b: FloatArray, scale: float, out: FloatArray) -> None:
    out[0] = (a[1] * b[2] - a[2] * b[1]) * scale
    out[1] = (a[2] * b[0] - a[0] * b[2]) * scale
    out[2] = (a[0] * b[1] - a[1] * b[0]) * scale


@numba.njit(cache=True, nogil=True, inline="always")
def _inside(point: FloatArray, rotation: FloatArray, place: FloatArray, out: FloatArray) -> float:
    """Length of a world point in the picture's frame, and the point itself into `out`."""
    x, y, z = point[0] - place[0], point[1] - place[1], point[2] - place[2]
    for axis in range(3):
        out[axis] = rotation[0, axis] * x + rotation[1, axis] * y + rotation[2, axis] * z
    return float(np.sqrt(x * x + y * y + z * z))


@numba.njit(cache=True, nogil=True)
def see(segments: FloatArray, rotation: FloatArray, place: FloatArray) -> Sight:
    """Lines at a pose.

    Args:
        segments: (L, 2, 3) m, world.
        rotation: (3, 3) R_world_picture.
        place: (3,) m, world.
    """
    count = len(segments)
    normals, directions, spans = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros((count, 3))
    from_start, to_end = np.zeros((count, 3)), np.zeros((count, 3))
    moments = np.zeros(count)
    start, end = np.empty(3), np.empty(3)
    for j in range(count):
        near_m = _inside(segments[j, 0], rotation, place, start)
        far_m = _inside(segments[j, 1], rotation, place, end)
        _cross_into(start, end, 1.0, normals[j])
        moment, length_m = np.sqrt(dot(normals[j], normals[j])), 0.0
        for axis in range(3):
            spans[j, axis] = start[axis] - end[axis]
            length_m += spans[j, axis] ** 2
        length_m = np.sqrt(length_m)
        if moment < MIN_DISTANCE_M * length_m or length_m == 0.0:
            normals[j] = 0.0
            continue
        for axis in range(3):
            normals[j, axis] /= moment
            directions[j, axis] = -spans[j, axis] / length_m
        moments[j] = moment
        _cross_into(normals[j], start, 1.0 / near_m, from_start[j])
        _cross_into(end, normals[j], 1.0 / far_m, to_end[j])
    return Sight(normals, moments, directions, spans, from_start, to_end)


@numba.njit(cache=True, nogil=True)
def _mark_alike(
    columns: Array,
    direction: Array,
    max_sine: np.float32,
    other: Array,
    least: np.float32,
    most: np.float32,
    middle: Array,
    reach: Array,
    alike: Array,
) -> None:
    """Mark arcs that may have a line's direction, whose normals agree with a vector, near a ray.

    Args:
        columns: (8, A) of the arcs.
        direction: (3,) of the line.
        max_sine: of the angle between arc and direction.
        other: (3,) vector.
        least, most: of the cosine between a normal and that vector, of either sign.
        middle: (3,) the ray.
        reach: (2,) cosine and sine of the angle to it, from the closest end of the arc.
        alike: (A,) or longer, the result.
    """
    dx, dy, dz = direction[0], direction[1], direction[2]
    ox, oy, oz = other[0], other[1], other[2]
    mx, my, mz = middle[0], middle[1], middle[2]
    reach_cosine, reach_sine = reach[0], reach[1]
    for a in range(columns.shape[1]):
        x, y, z = columns[0, a], columns[1, a], columns[2, a]
        way = abs(x * dx + y * dy + z * dz)
        along = abs(x * ox + y * oy + z * oz)
        ahead = columns[3, a] * mx + columns[4, a] * my + columns[5, a] * mz
        behind = reach_cosine * columns[6, a] - reach_sine * columns[7, a]
        alike[a] = (way <= max_sine) & (along >= least) & (along <= most) & (ahead >= behind)


@numba.njit(cache=True, nogil=True)
def _set_reach(reach_rad: float, reach: Array) -> None:
    """Cosine and sine for `_mark_alike`; beyond a right angle arcs may be anywhere."""
    reach[0], reach[1] = np.cos(reach_rad), np.sin(reach_rad)
    if reach_rad >= np.pi / 2:
        reach[0], reach[1] = 0.0, np.inf


@numba.njit(cache=True, nogil=True)
def _marked(alike: Array, found: IntArray) -> int:
    """Number of marks, and which they are into `found`; few are, and eight at a time passed over."""
    count = 0
    eights = alike.view(np.uint64)
    for eight in range(len(eights)):
        if eights[eight] != 0:
            for a in range(8 * eight, 8 * eight + 8):
                if alike[a]:
                    found[count] = a
                    count += 1
    return count


@numba.njit(cache=True, nogil=True)
def _set_middle(sight: Sight, j: int, middle: Array) -> float:
    """Half the length of a line's image, rad, and the unit ray in its middle into `middle`."""
    nx, ny, nz = sight.normals[j, 0], sight.normals[j, 1], sight.normals[j, 2]
    # The rays to both ends are from_start x normal and normal x to_end.
    dx = sight.to_end[j, 0] - sight.from_start[j, 0]
    dy = sight.to_end[j, 1] - sight.from_start[j, 1]
    dz = sight.to_end[j, 2] - sight.from_start[j, 2]
    x, y, z = ny * dz - nz * dy, nz * dx - nx * dz, nx * dy - ny * dx
    twice_cosine = max(np.sqrt(x * x + y * y + z * z), 1e-12)
    middle[0], middle[1], middle[2] = x / twice_cosine, y / twice_cosine, z / twice_cosine
    return float(np.arccos(min(1.0, 0.5 * twice_cosine)))


@numba.njit(cache=True, nogil=True)
def near(
    sight: Sight,
    samples: Samples,
    max_angle_rad: float,
    max_residual_rad: float,
    slack_rad: float,
) -> Pairs:
    """Lines that rays of an arc may lie on at this pose, and at others that are close to it.

    Args:
        sight: the lines.
        samples: the arcs.
        max_angle_rad: between arcs and lines, as `match_rays` has it.
        max_residual_rad: rays that are farther off a line do not count.
        slack_rad: how much closer they may come at the other poses.
    """
    lines, arcs = np.empty(4096, np.int64), np.empty(4096, np.int64)
    count = 0
    min_cosine = np.float32(np.cos(max(max_angle_rad, MIN_NORMAL_GATE_RAD) + slack_rad))
    max_sine = np.float32(np.sin(max_angle_rad + slack_rad))
    max_off = np.sin(min(max_residual_rad + slack_rad, np.pi / 2))
    half_rad = np.minimum(samples.reach_rad, np.pi / 2)
    half_cosine, half_sine = np.cos(half_rad), np.sin(half_rad)
    beyond = -np.sin(np.minimum(samples.reach_rad + END_SLACK_RAD + slack_rad, np.pi / 2))
    normals, directions = sight.normals.astype(np.float32), sight.directions.astype(np.float32)
    middle, reach = np.empty(3, np.float32), np.empty(2, np.float32)
    alike = np.zeros((len(half_rad) + 7) // 8 * 8, np.uint8)
    found = np.empty(len(alike), np.int64)
    around_rad = max_residual_rad + END_SLACK_RAD + slack_rad
    for j in range(len(normals)):
        _set_reach(_set_middle(sight, j, middle) + around_rad, reach)
        _mark_alike(
            samples.columns,
            directions[j],
            max_sine,
            normals[j],
            min_cosine,
            np.float32(2.0),
            middle,
            reach,
            alike,
        )
        for index in range(_marked(alike, found)):
            a = found[index]
            off = half_cosine[a] * abs(_dots(samples.middles, a, sight.normals, j))
            off -= half_sine[a] * abs(_dots(samples.asides, a, sight.normals, j))
            if off > max_off:
                continue
            ahead = _dots(samples.middles, a, sight.from_start, j)
            if min(ahead, _dots(samples.middles, a, sight.to_end, j)) < beyond[a]:
                continue
            if count == len(lines):
                lines = np.concatenate((lines, np.empty_like(lines)))
                arcs = np.concatenate((arcs, np.empty_like(arcs)))
            lines[count], arcs[count] = j, a
            count += 1
    return Pairs(lines[:count], arcs[:count])


@numba.njit(cache=True, nogil=True)
def match_rays(
    sight: Sight,
    samples: Samples,
    pairs: Pairs,
    max_angle_rad: float,
    reach_rad: float,
) -> tuple[IntArray, FloatArray, IntArray]:
    """(S,) nearest line of each ray, -1 for none; (S,) sine of the angle; (S,) lines within reach.

    Lines must have the arc's direction, hold the ray between their ends, and their viewing planes
    agree with the arc's.

    Args:
        sight: the lines.
        samples: the arcs.
        pairs: of both, that are asked.
        max_angle_rad: between arcs and lines.
        reach_rad: as said.
    """
    count = len(samples.cosine)
    line, residual = np.full(count, -1, np.int64), np.zeros(count)
    crowd = np.zeros(count, np.int64)
    max_sine, reach = np.sin(max_angle_rad), np.sin(reach_rad)
    min_cosine = np.cos(max(max_angle_rad, MIN_NORMAL_GATE_RAD))
    for index in range(len(pairs.line)):
        j, a = pairs.line[index], pairs.arc[index]
        if abs(_dots(samples.normals, a, sight.normals, j)) < min_cosine:
            continue
        if abs(_dots(samples.normals, a, sight.directions, j)) > max_sine:
            continue
        off_m = _dots(samples.middles, a, sight.normals, j)
        off_a = _dots(samples.asides, a, sight.normals, j)
        outermost = samples.offsets[a]
        least = samples.cosine[outermost] * abs(off_m) + samples.sine[outermost] * abs(off_a)
        if least > reach:
            continue  # the outermost rays, whose sines are -+ the same, are the closest
        start_m = _dots(samples.middles, a, sight.from_start, j)
        start_a = _dots(samples.asides, a, sight.from_start, j)
        end_m = _dots(samples.middles, a, sight.to_end, j)
        end_a = _dots(samples.asides, a, sight.to_end, j)
        for s in range(samples.offsets[a], samples.offsets[a + 1]):
            c, t = samples.cosine[s], samples.sine[s]
            off = c * off_m + t * off_a
            if abs(off) > reach:
                continue
            if min(c * start_m + t * start_a, c * end_m + t * end_a) < -END_SLACK_SINE:
                continue
            crowd[s] += 1
            if line[s] < 0 or abs(off) < abs(residual[s]):
                line[s], residual[s] = j, off
    return line, residual, crowd


@numba.njit(cache=True, nogil=True)
def match_points(
    lines: LinePoints,
    rotation: FloatArray,
    place: FloatArray,
    samples: Samples,
    max_angle_rad: float,
    reach_rad: float,
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """Points of lines as seen at a pose, and the arcs that they lie on.

    Arcs must be alike in direction.

    Args:
        lines: with their points.
        rotation, place: (3, 3) R_world_picture and (3,) m.
        samples: the arcs.
        max_angle_rad: between the directions.
        reach_rad: arcs that are farther off a point do not count.

    Returns:
        (P, 3) unit rays of the points; (P,) angle that each stands for, rad; (P,) sine of the angle
        to the nearest arc, infinite without one; (P,) arcs within reach.
    """
    count = len(lines.points)
    rays, weight = np.empty((count, 3)), np.empty(count)
    nearest, crowd = np.full(count, np.inf), np.zeros(count, np.int64)
    max_sine, reach = np.float32(np.sin(max_angle_rad)), np.sin(reach_rad)
    end_cosine, end_sine = np.cos(samples.reach_rad), np.sin(samples.reach_rad)
    alike = np.zeros((len(end_sine) + 7) // 8 * 8, np.uint8)
    found, around = np.empty(len(alike), np.int64), np.empty(2, np.float32)
    for j in range(len(lines.directions)):
        first, last = lines.offsets[j], lines.offsets[j + 1]
        direction = lines.directions[j] @ rotation
        for p in range(first, last):
            distance_m = max(_inside(lines.points[p], rotation, place, rays[p]), MIN_DISTANCE_M)
            for axis in range(3):
                rays[p, axis] /= distance_m
            across = np.sqrt(max(0.0, 1.0 - dot(rays[p], direction) ** 2))
            weight[p] = lines.length_m[p] * across / distance_m
        middle = rays[(first + last) // 2]
        half = min(dot(middle, rays[first]), dot(middle, rays[last - 1]))
        half_rad = np.arccos(max(-1.0, min(1.0, half)))
        _set_reach(half_rad + reach_rad + END_SLACK_RAD, around)
        _mark_alike(
            samples.columns,
            direction.astype(np.float32),
            max_sine,
            middle.astype(np.float32),
            np.float32(0.0),
            np.float32(np.sin(min(half_rad + reach_rad, np.pi / 2))),
            middle.astype(np.float32),
            around,
            alike,
        )
        for index in range(_marked(alike, found)):
            a = found[index]
            for p in range(first, last):
                off = abs(_dots(rays, p, samples.normals, a))
                if off > reach:
                    continue
                ahead = _dots(rays, p, samples.middles, a)
                beside = _dots(rays, p, samples.asides, a)
                # Between the ends: normal x start and end x normal, in the arc's own axes.
                if end_sine[a] * ahead - end_cosine[a] * abs(beside) >= -END_SLACK_SINE:
                    crowd[p] += 1
                    nearest[p] = min(nearest[p], off)
    return rays, weight, nearest, crowd
