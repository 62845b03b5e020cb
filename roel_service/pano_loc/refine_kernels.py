"""Loops over arcs and map lines at one pose."""

from __future__ import annotations

import numba
import numpy as np

from roel_service.arrays import Array, BoolArray, FloatArray, IntArray

# Lines whose viewing plane is not defined, or closer to the centre than this, are left out, m.
MIN_DISTANCE_M = 0.05
# A ray belongs to a line's image up to this far beyond its ends.
END_SLACK_RAD = np.deg2rad(1.5)
END_SLACK_SINE = np.sin(END_SLACK_RAD)
# Viewing planes of arc and line differ by no more than this, or the arc's own error if larger.
MIN_NORMAL_GATE_RAD = np.deg2rad(15.0)
# Rays that are off by more widths of the kernel do not count.
CUTOFF_WIDTHS = 3.0


@numba.njit(cache=True, nogil=True, inline="always")
def _dot(a: FloatArray, b: FloatArray) -> float:
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


@numba.njit(cache=True, nogil=True, inline="always")
def _cross(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@numba.njit(cache=True, nogil=True)
def viewed_lines(
    segments: FloatArray, place: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, BoolArray]:
    """Lines as seen from a place: normals, their lengths (m^2), two end normals, and which count.

    The end normals n x start and end x n point into the image of the line.
    """
    count = len(segments)
    normal, from_start, to_end = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros((count, 3))
    moment, sound = np.zeros(count), np.zeros(count, np.bool_)
    px, py, pz = place
    for j in range(count):
        # In scalars: arrays of three would be allocated thousands of times a pose.
        ax, ay, az = segments[j, 0, 0] - px, segments[j, 0, 1] - py, segments[j, 0, 2] - pz
        bx, by, bz = segments[j, 1, 0] - px, segments[j, 1, 1] - py, segments[j, 1, 2] - pz
        mx, my, mz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        size = np.sqrt(mx * mx + my * my + mz * mz)
        length = np.sqrt((bx - ax) ** 2 + (by - ay) ** 2 + (bz - az) ** 2)
        if size < MIN_DISTANCE_M * length or length == 0.0:
            continue
        nx, ny, nz = mx / size, my / size, mz / size
        normal[j, 0], normal[j, 1], normal[j, 2] = nx, ny, nz
        moment[j], sound[j] = size, True
        near, far = np.sqrt(ax * ax + ay * ay + az * az), np.sqrt(bx * bx + by * by + bz * bz)
        from_start[j, 0] = (ny * az - nz * ay) / near
        from_start[j, 1] = (nz * ax - nx * az) / near
        from_start[j, 2] = (nx * ay - ny * ax) / near
        to_end[j, 0] = (by * nz - bz * ny) / far
        to_end[j, 1] = (bz * nx - bx * nz) / far
        to_end[j, 2] = (bx * ny - by * nx) / far
    return normal, moment, from_start, to_end, sound


@numba.njit(cache=True, nogil=True)
def _mark_alike(
    arc: Array,
    planes: Array,
    ways: Array,
    min_cosine: np.float32,
    max_sine: np.float32,
    reach: Array,
    max_off: np.float32,
    alike: Array,
) -> None:
    """Mark lines whose viewing planes (3, L) and directions (3, L) agree with an arc's.

    Args:
        arc: (3, 3) rows are the arc's normal, its middle and what is across both.
        planes, ways: as said.
        min_cosine, max_sine: between the normals of both, and of arc and direction.
        reach: (2,) cosine and sine of half the arc's length.
        max_off: sine of the angle by which the arc's nearest ray may be off the plane.
        alike: (L,) or longer, the result.
    """
    nx, ny, nz = arc[0]
    mx, my, mz = arc[1]
    ax, ay, az = arc[2]
    for j in range(planes.shape[1]):
        px, py, pz = planes[0, j], planes[1, j], planes[2, j]
        plane = abs(nx * px + ny * py + nz * pz)
        way = abs(nx * ways[0, j] + ny * ways[1, j] + nz * ways[2, j])
        middle, across = abs(mx * px + my * py + mz * pz), abs(ax * px + ay * py + az * pz)
        off = reach[0] * middle - reach[1] * across
        alike[j] = (plane >= min_cosine) & (way <= max_sine) & (off <= max_off)


@numba.njit(cache=True, nogil=True)
def nearby_lines(
    middles: FloatArray,
    reach_rad: FloatArray,
    normals: FloatArray,
    directions: FloatArray,
    seen: tuple[FloatArray, FloatArray, FloatArray, FloatArray, BoolArray],
    max_angle_rad: float,
    max_residual_rad: float,
    slack_rad: float,
) -> tuple[IntArray, IntArray]:
    """Lines that rays of an arc may lie on, also at poses that are a little off.

    Args:
        middles: (A, 3) unit, of the arcs, world.
        reach_rad: (A,) half their lengths.
        normals: (A, 3) unit, of the arcs, world.
        directions: (L, 3) unit, of the lines.
        seen: what `viewed_lines` found.
        max_angle_rad: between arcs and lines, as `match_rays` has it.
        max_residual_rad: rays that are farther off a line do not count.
        slack_rad: how much more is allowed for other poses.

    Returns:
        (A + 1,) offsets; lines of arc a are lines[offsets[a]:offsets[a + 1]].
    """
    normal, _, from_start, to_end, sound = seen
    offsets = np.zeros(len(normals) + 1, np.int64)
    lines = np.empty(16 * len(normals) + 16, np.int64)
    count = 0
    min_cosine = np.float32(np.cos(max(max_angle_rad, MIN_NORMAL_GATE_RAD) + slack_rad))
    max_sine = np.float32(np.sin(max_angle_rad + slack_rad))
    max_off = np.float32(np.sin(min(max_residual_rad + slack_rad, np.pi / 2)))
    # By coordinate and short, so that one instruction takes several lines; few are alike, so that
    # eight at a time are passed over.
    planes = np.ascontiguousarray(normal.T.astype(np.float32))
    ways = np.ascontiguousarray(directions.T.astype(np.float32))
    alike = np.zeros((len(directions) + 7) // 8 * 8, np.uint8)
    eights = alike.view(np.uint64)
    arc, reach = np.empty((3, 3), np.float32), np.empty(2, np.float32)
    across = np.empty(3)
    for a in range(len(normals)):
        _cross(normals[a], middles[a], across)
        arc[0], arc[1], arc[2] = normals[a], middles[a], across
        half_rad = min(reach_rad[a], np.pi / 2)
        reach[0], reach[1] = np.cos(half_rad), np.sin(half_rad)
        _mark_alike(arc, planes, ways, min_cosine, max_sine, reach, max_off, alike)
        x, y, z = middles[a]
        beyond = -np.sin(min(reach_rad[a] + END_SLACK_RAD + slack_rad, np.pi / 2))
        for eight in range(len(eights)):
            if eights[eight] == 0:
                continue
            for j in range(8 * eight, min(8 * eight + 8, len(directions))):
                if not (alike[j] and sound[j]):
                    continue
                if x * from_start[j, 0] + y * from_start[j, 1] + z * from_start[j, 2] < beyond:
                    continue
                if x * to_end[j, 0] + y * to_end[j, 1] + z * to_end[j, 2] < beyond:
                    continue
                if count == len(lines):
                    lines = np.concatenate((lines, np.empty_like(lines)))
                lines[count] = j
                count += 1
        offsets[a + 1] = count
    return offsets, lines[:count]


@numba.njit(cache=True, nogil=True)
def match_rays(
    rays: FloatArray,
    offsets: IntArray,
    normals: FloatArray,
    directions: FloatArray,
    seen: tuple[FloatArray, FloatArray, FloatArray, FloatArray, BoolArray],
    nearby: tuple[IntArray, IntArray],
    max_angle_rad: float,
) -> tuple[IntArray, FloatArray]:
    """(S,) line that each ray of an arc lies nearest to, -1 for none; (S,) sine of the angle.

    Lines must have the arc's direction, hold the ray between their ends, and their viewing planes
    agree with the arc's.

    Args:
        rays: (S, 3) unit, world; those of arc a are offsets[a]:offsets[a + 1].
        offsets: (A + 1,).
        normals: (A, 3) unit, of the arcs, world.
        directions: (L, 3) unit, of the lines.
        seen: what `viewed_lines` found.
        nearby: what `nearby_lines` found: the lines that are asked.
        max_angle_rad: between arcs and lines.
    """
    normal, _, from_start, to_end, sound = seen
    first, near = nearby
    line = np.full(len(rays), -1, np.int64)
    residual = np.zeros(len(rays))
    sine = np.sin(max_angle_rad)
    cosine = np.cos(max(max_angle_rad, MIN_NORMAL_GATE_RAD))
    for a in range(len(normals)):
        nx, ny, nz = normals[a, 0], normals[a, 1], normals[a, 2]
        for index in range(first[a], first[a + 1]):
            j = near[index]
            mx, my, mz = normal[j, 0], normal[j, 1], normal[j, 2]
            if abs(nx * mx + ny * my + nz * mz) < cosine or not sound[j]:
                continue
            off = nx * directions[j, 0] + ny * directions[j, 1] + nz * directions[j, 2]
            if abs(off) > sine:
                continue
            fx, fy, fz = from_start[j, 0], from_start[j, 1], from_start[j, 2]
            tx, ty, tz = to_end[j, 0], to_end[j, 1], to_end[j, 2]
            for s in range(offsets[a], offsets[a + 1]):
                x, y, z = rays[s, 0], rays[s, 1], rays[s, 2]
                off = x * mx + y * my + z * mz
                if line[s] >= 0 and abs(off) >= abs(residual[s]):
                    continue
                if x * fx + y * fy + z * fz < -END_SLACK_SINE:
                    continue
                if x * tx + y * ty + z * tz < -END_SLACK_SINE:
                    continue
                line[s], residual[s] = j, off
    return line, residual


@numba.njit(cache=True, nogil=True)
def crowd_on_rays(
    rays: FloatArray,
    offsets: IntArray,
    normals: FloatArray,
    directions: FloatArray,
    seen: tuple[FloatArray, FloatArray, FloatArray, FloatArray, BoolArray],
    nearby: tuple[IntArray, IntArray],
    max_angle_rad: float,
    reach_rad: float,
) -> tuple[FloatArray, IntArray]:
    """(S,) sine of the angle to the nearest line of each ray, and (S,) lines within reach of it.

    Infinite where no line is within reach. Lines must have the arc's direction, and hold the ray
    between their ends.

    Args:
        rays, offsets, normals, directions, seen, nearby, max_angle_rad: as `match_rays` has them.
        reach_rad: as said.
    """
    normal, _, from_start, to_end, sound = seen
    first, near = nearby
    least, count = np.full(len(rays), np.inf), np.zeros(len(rays), np.int64)
    sine, reach = np.sin(max_angle_rad), np.sin(reach_rad)
    for a in range(len(normals)):
        for index in range(first[a], first[a + 1]):
            j = near[index]
            if not sound[j] or abs(_dot(normals[a], directions[j])) > sine:
                continue
            mx, my, mz = normal[j, 0], normal[j, 1], normal[j, 2]
            fx, fy, fz = from_start[j, 0], from_start[j, 1], from_start[j, 2]
            tx, ty, tz = to_end[j, 0], to_end[j, 1], to_end[j, 2]
            for s in range(offsets[a], offsets[a + 1]):
                x, y, z = rays[s, 0], rays[s, 1], rays[s, 2]
                off = abs(x * mx + y * my + z * mz)
                if off > reach:
                    continue
                if x * fx + y * fy + z * fz < -END_SLACK_SINE:
                    continue
                if x * tx + y * ty + z * tz < -END_SLACK_SINE:
                    continue
                count[s] += 1
                least[s] = min(least[s], off)
    return least, count


@numba.njit(cache=True, nogil=True)
def normal_equations(
    rays: FloatArray,
    weight: FloatArray,
    segments: FloatArray,
    seen: tuple[FloatArray, FloatArray, FloatArray, FloatArray, BoolArray],
    line: IntArray,
    residual: FloatArray,
    scale_rad: float,
) -> tuple[FloatArray, FloatArray]:
    """(6, 6) Gauss-Newton sum of Geman-McClure weighted residuals, and (L, 6) gradient by line.

    Tangent (r, d). The residual of a ray y is y . N, N the unit normal of the plane of centre and
    line; rays are in the world's frame.
    """
    normal, moment = seen[0], seen[1]
    H, g = np.zeros((6, 6)), np.zeros((len(segments), 6))
    J = np.empty(6)
    for s in range(len(rays)):
        j = line[s]
        if j < 0 or abs(residual[s]) > CUTOFF_WIDTHS * scale_rad:
            continue
        jacobian(rays[s], segments[j], normal[j], moment[j], J)
        robust = weight[s] / (1.0 + (residual[s] / scale_rad) ** 2) ** 2
        for p in range(6):
            g[j, p] += robust * residual[s] * J[p]
            for q in range(6):
                H[p, q] += robust * J[p] * J[q]
    return H, g


@numba.njit(cache=True, nogil=True)
def jacobian(
    ray: FloatArray, segment: FloatArray, normal: FloatArray, moment: float, out: FloatArray
) -> None:
    """Derivative of ray . N by the turn and the shift of the pose, into `out` (6,)."""
    along = _dot(ray, normal)
    _cross(ray, normal, out[:3])
    _cross(segment[0] - segment[1], ray - along * normal, out[3:])
    out[3:] /= moment


@numba.njit(cache=True, nogil=True)
def _mark_passing(
    direction: Array,
    middle: Array,
    normals: Array,
    sine: np.float32,
    reach_sine: np.float32,
    near: BoolArray,
) -> None:
    """Mark arcs of (3, A) normals that have a line's direction and pass by its middle."""
    dx, dy, dz = direction
    x, y, z = middle
    for a in range(len(near)):
        off = abs(dx * normals[0, a] + dy * normals[1, a] + dz * normals[2, a])
        aside = abs(x * normals[0, a] + y * normals[1, a] + z * normals[2, a])
        near[a] = (off <= sine) & (aside <= reach_sine)


@numba.njit(cache=True, nogil=True)
def match_points(
    points: FloatArray,
    offsets: IntArray,
    directions: FloatArray,
    normals: FloatArray,
    from_start: FloatArray,
    to_end: FloatArray,
    max_angle_rad: float,
    reach_rad: float,
) -> tuple[FloatArray, IntArray]:
    """(P,) sine of the angle from points of map lines to the nearest arc, (P,) arcs within reach.

    Infinite where no arc is within reach. Arcs must be alike in direction.

    Args:
        points: (P, 3) unit rays, panorama frame; those of line j are offsets[j]:offsets[j + 1].
        offsets: (L + 1,).
        directions: (L, 3) unit, of the lines, panorama frame.
        normals: (A, 3) unit, of the arcs.
        from_start, to_end: (A, 3) unit, normal x start and end x normal.
        max_angle_rad: between the directions.
        reach_rad: as said.
    """
    nearest, crowd = np.full(len(points), np.inf), np.zeros(len(points), np.int64)
    sine, within = np.sin(max_angle_rad), np.sin(reach_rad)
    # By coordinate and short, so that one instruction takes several arcs.
    columns = np.ascontiguousarray(normals.T.astype(np.float32))
    near, alike = np.empty(len(normals), np.bool_), np.empty(len(normals), np.int64)
    for j in range(len(directions)):
        first, last = offsets[j], offsets[j + 1]
        middle = points[(first + last) // 2]
        half = min(_dot(middle, points[first]), _dot(middle, points[last - 1]))
        half_rad = np.arccos(max(-1.0, min(1.0, half)))
        _mark_passing(
            directions[j].astype(np.float32),
            middle.astype(np.float32),
            columns,
            np.float32(sine),
            np.float32(np.sin(min(half_rad + reach_rad, np.pi / 2))),
            near,
        )
        count = 0
        for a in range(len(normals)):
            if near[a]:
                alike[count] = a
                count += 1
        for p in range(first, last):
            x, y, z = points[p, 0], points[p, 1], points[p, 2]
            for index in range(count):
                a = alike[index]
                off = abs(x * normals[a, 0] + y * normals[a, 1] + z * normals[a, 2])
                if off > within:
                    continue
                ahead = x * from_start[a, 0] + y * from_start[a, 1] + z * from_start[a, 2]
                behind = x * to_end[a, 0] + y * to_end[a, 1] + z * to_end[a, 2]
                if min(ahead, behind) >= -END_SLACK_SINE:
                    crowd[p] += 1
                    nearest[p] = min(nearest[p], off)
    return nearest, crowd
