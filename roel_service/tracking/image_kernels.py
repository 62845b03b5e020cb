"""Loops over pieces of the map and over events: what is where in the picture."""

from __future__ import annotations

import math

import numba
import numpy as np

from roel_service.arrays import Array, BoolArray, FloatArray, IntArray

# Nothing of the map is near a pixel.
NO_PIECE = -1
# Below this square of an angle, sin(x)/x and its relatives are told by their series.
SMALL_SQUARE_RAD2 = 1e-8
# Parts of a piece of which it is noted whether events lie on them; bits of a 64-bit number.
MAX_BIN_COUNT = 64


@numba.njit(cache=True, nogil=True, error_model="numpy")
def project(
    segments: FloatArray,
    R_world_camera: FloatArray,
    centre: FloatArray,
    K: FloatArray,
    width: int,
    height: int,
    min_depth_m: float,
) -> tuple[FloatArray, FloatArray]:
    """(P, 4) images x0 y0 x1 y1 of (P, 2, 3) pieces, px, cut to the picture, and (P,) depths, m.

    The depth is that of the middle of what is seen; 0 where nothing is.
    """
    images = np.zeros((len(segments), 4))
    depths_m = np.zeros(len(segments))
    a, b = np.empty(3), np.empty(3)
    for p in range(len(segments)):
        for row in range(3):
            a[row], b[row] = 0.0, 0.0
            for i in range(3):
                a[row] += R_world_camera[i, row] * (segments[p, 0, i] - centre[i])
                b[row] += R_world_camera[i, row] * (segments[p, 1, i] - centre[i])
        if a[2] < min_depth_m and b[2] < min_depth_m:
            continue
        if a[2] < min_depth_m:
            a += (b - a) * ((min_depth_m - a[2]) / (b[2] - a[2]))
        elif b[2] < min_depth_m:
            b += (a - b) * ((min_depth_m - b[2]) / (a[2] - b[2]))
        x0, y0 = K[0, 0] * a[0] / a[2] + K[0, 2], K[1, 1] * a[1] / a[2] + K[1, 2]
        x1, y1 = K[0, 0] * b[0] / b[2] + K[0, 2], K[1, 1] * b[1] / b[2] + K[1, 2]
        first, last = _inside(x0, y0, x1, y1, width - 1.0, height - 1.0)
        if last <= first:
            continue
        images[p, 0], images[p, 1] = x0 + first * (x1 - x0), y0 + first * (y1 - y0)
        images[p, 2], images[p, 3] = x0 + last * (x1 - x0), y0 + last * (y1 - y0)
        # Inverse depth is linear along the image of a line.
        middle = 0.5 * (first + last)
        depths_m[p] = 1.0 / ((1.0 - middle) / a[2] + middle / b[2])
    return images, depths_m


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _inside(
    x0: float, y0: float, x1: float, y1: float, right: float, bottom: float
) -> tuple[float, float]:
    """Shares of a segment between which it lies in the picture (Liang and Barsky, 1984)."""
    first, last = 0.0, 1.0
    for step, room in (
        (x0 - x1, x0),
        (x1 - x0, right - x0),
        (y0 - y1, y0),
        (y1 - y0, bottom - y0),
    ):
        if step == 0.0:
            if room < 0.0:
                return 1.0, 0.0
        elif step < 0.0:
            first = max(first, room / step)
        else:
            last = min(last, room / step)
    return first, last


@numba.njit(cache=True, nogil=True, error_model="numpy")
def draw_nearest(images: FloatArray, reach_px: float, width: int, height: int) -> Array:
    """(H, W) int32: the piece nearest to each pixel, of those within `reach_px`.

    Args:
        images: (P, 4) of `project`; a piece of no length is not drawn.
    """
    nearest = np.full((height, width), NO_PIECE, np.int32)
    distance_px = np.full((height, width), np.float32(reach_px))
    for p in range(len(images)):
        x0, y0, x1, y1 = images[p]
        dx, dy = x1 - x0, y1 - y0
        length = math.hypot(dx, dy)
        if length < 1.0:
            continue
        steep = abs(dy) > abs(dx)
        if steep:
            x0, y0, x1, y1, dx, dy = y0, x0, y1, x1, dy, dx
        across = abs(dx) / length
        slope = dy / dx
        sides = height if not steep else width
        for u in range(math.ceil(min(x0, x1)), math.floor(max(x0, x1)) + 1):
            v = y0 + slope * (u - x0)
            low = max(0, math.ceil(v - reach_px / across))
            high = min(sides - 1, math.floor(v + reach_px / across))
            for w in range(low, high + 1):
                d = np.float32(abs(w - v) * across)
                row, column = (u, w) if steep else (w, u)
                if d < distance_px[row, column]:
                    distance_px[row, column] = d
                    nearest[row, column] = p
    return nearest


@numba.njit(cache=True, nogil=True, error_model="numpy")
def retracted(
    R_world_camera: FloatArray, centre: FloatArray, steps: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(N, 3, 3) rotations and (N, 3) centres of one pose after each of (N, 6) steps (r, d)."""
    rotations, centres = np.empty((len(steps), 3, 3)), np.empty((len(steps), 3))
    for n in range(len(steps)):
        x, y, z = steps[n, 0], steps[n, 1], steps[n, 2]
        square = x * x + y * y + z * z
        if square < SMALL_SQUARE_RAD2:
            sine, cosine = 1.0 - square / 6.0, 0.5 - square / 24.0
        else:
            angle = math.sqrt(square)
            sine, cosine = math.sin(angle) / angle, (1.0 - math.cos(angle)) / square
        for column in range(3):
            a, b, c = (
                R_world_camera[0, column],
                R_world_camera[1, column],
                R_world_camera[2, column],
            )
            # Rodrigues: v + sine (r x v) + cosine (r x (r x v)).
            u, v, w = y * c - z * b, z * a - x * c, x * b - y * a
            rotations[n, 0, column] = a + sine * u + cosine * (y * w - z * v)
            rotations[n, 1, column] = b + sine * v + cosine * (z * u - x * w)
            rotations[n, 2, column] = c + sine * w + cosine * (x * v - y * u)
        for i in range(3):
            centres[n, i] = centre[i] + steps[n, 3 + i]
    return rotations, centres


@numba.njit(cache=True, nogil=True, error_model="numpy")
def pieces_near(
    xy_px: FloatArray, slot: IntArray, turns: FloatArray, K: FloatArray, nearest: Array
) -> Array:
    """(K,) int32: the piece near each event, once the turn since its slot is undone.

    Args:
        xy_px: (K, 2) ideal pixels at the events' own times.
        slot: (K,) of each event.
        turns: (S, 3, 3) rotations from the camera at the slot to that of the picture.
        nearest: (H, W) of `draw_nearest`.
    """
    height, width = nearest.shape
    piece = np.empty(len(xy_px), np.int32)
    for k in range(len(xy_px)):
        R = turns[slot[k]]
        x, y = (xy_px[k, 0] - K[0, 2]) / K[0, 0], (xy_px[k, 1] - K[1, 2]) / K[1, 1]
        depth = R[2, 0] * x + R[2, 1] * y + R[2, 2]
        # Rounded to whole pixels.
        u = K[0, 0] * (R[0, 0] * x + R[0, 1] * y + R[0, 2]) / depth + K[0, 2] + 0.5
        v = K[1, 1] * (R[1, 0] * x + R[1, 1] * y + R[1, 2]) / depth + K[1, 2] + 0.5
        # A pixel that the calibration cannot undistort is not a number, and in no picture.
        if u >= 0.0 and v >= 0.0 and u < width and v < height:
            piece[k] = nearest[int(v), int(u)]
        else:
            piece[k] = NO_PIECE
    return piece


@numba.njit(cache=True, nogil=True, error_model="numpy")
def distances(
    xy_px: FloatArray,
    slot: IntArray,
    piece: Array,
    R_world_slot: FloatArray,
    centres: FloatArray,
    K: FloatArray,
    segments: FloatArray,
    direction: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Signed distances (px) of events from the images of their lines, and their Jacobians.

    With the ray (x, y, 1) at depth 1 and the line's moment m_c about the camera centre, in camera
    axes, the distance is f (x, y, 1) . m_c / |(m_c,x, m_c,y)|.

    Args:
        xy_px: (K, 2) ideal pixels at the events' own times.
        slot: (K,) slot of each event, whose pose is that of the event.
        piece: (K,) a piece for every event.
        R_world_slot, centres: (S, 3, 3), (S, 3) poses of the slots.
        segments, direction: of the pieces.

    Returns:
        (K,) distances, and (K, 6) their derivatives by a step (r, d) of the pose of the slot.
    """
    focal_px = math.sqrt(K[0, 0] * K[1, 1])
    residual_px = np.empty(len(xy_px))
    jacobian = np.empty((len(xy_px), 6))
    for k in range(len(xy_px)):
        R, c = R_world_slot[slot[k]], centres[slot[k]]
        p, v = segments[piece[k], 0], direction[piece[k]]
        px, py, pz = p[0] - c[0], p[1] - c[1], p[2] - c[2]
        # Moment about the camera centre, world axes.
        mx, my, mz = py * v[2] - pz * v[1], pz * v[0] - px * v[2], px * v[1] - py * v[0]
        qx = R[0, 0] * mx + R[1, 0] * my + R[2, 0] * mz
        qy = R[0, 1] * mx + R[1, 1] * my + R[2, 1] * mz
        qz = R[0, 2] * mx + R[1, 2] * my + R[2, 2] * mz
        length = max(math.sqrt(qx * qx + qy * qy), 1e-12)
        x, y = (xy_px[k, 0] - K[0, 2]) / K[0, 0], (xy_px[k, 1] - K[1, 2]) / K[1, 1]
        sine = (x * qx + y * qy + qz) / length
        residual_px[k] = focal_px * sine
        # Derivative of the distance by the moment, camera axes, then world axes.
        scale = focal_px / length
        ax, ay, az = scale * (x - sine * qx / length), scale * (y - sine * qy / length), scale
        gx = R[0, 0] * ax + R[0, 1] * ay + R[0, 2] * az
        gy = R[1, 0] * ax + R[1, 1] * ay + R[1, 2] * az
        gz = R[2, 0] * ax + R[2, 1] * ay + R[2, 2] * az
        jacobian[k, 0] = gy * mz - gz * my
        jacobian[k, 1] = gz * mx - gx * mz
        jacobian[k, 2] = gx * my - gy * mx
        jacobian[k, 3] = gy * v[2] - gz * v[1]
        jacobian[k, 4] = gz * v[0] - gx * v[2]
        jacobian[k, 5] = gx * v[1] - gy * v[0]
    return residual_px, jacobian


@numba.njit(cache=True, nogil=True, error_model="numpy")
def event_weights(
    residual_px: FloatArray,
    piece: Array,
    counts: BoolArray,
    line_px2: FloatArray,
    event_px2: float,
    reach_px: float,
) -> FloatArray:
    """(K,) weights of events, 1/px^2: Tukey's, over the variance of all of a piece together.

    Args:
        residual_px: (K,) distances from the pieces.
        piece: (K,) of each event.
        counts: (P,) whether a piece has a say.
        line_px2: (P,) variance of a piece, which all of its events share.
        event_px2: variance of one event.
        reach_px: events farther away have no weight.
    """
    weight = np.zeros(len(residual_px))
    sums = np.zeros(len(counts))
    for k in range(len(residual_px)):
        if counts[piece[k]]:
            near = max(0.0, 1.0 - (residual_px[k] / reach_px) ** 2)
            weight[k] = near * near
            sums[piece[k]] += weight[k]
    for k in range(len(residual_px)):
        weight[k] /= event_px2 + sums[piece[k]] * line_px2[piece[k]]
    return weight


@numba.njit(cache=True, nogil=True, error_model="numpy")
def normal_equations(
    residual_px: FloatArray, by_pose: FloatArray, after_s: FloatArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(12, 12) sum of w j j^T and (12,) sum of w j r, with j = (by_pose, after_s by_pose).

    Args:
        residual_px: (K,) r.
        by_pose: (K, 6) derivatives by a step of the pose at the event's own time.
        after_s: (K,) that time, after the time of the state.
        weight: (K,) w.
    """
    information = np.zeros((12, 12))
    slope = np.zeros(12)
    # Sums over events of one time, one after the other.
    products, residuals = np.zeros((6, 6)), np.zeros(6)
    count = len(residual_px)
    for k in range(count):
        if weight[k] != 0.0:
            for row in range(6):
                share = weight[k] * by_pose[k, row]
                residuals[row] += share * residual_px[k]
                for column in range(row + 1):
                    products[row, column] += share * by_pose[k, column]
        t = after_s[k]
        if k + 1 < count and after_s[k + 1] == t:
            continue
        for row in range(6):
            slope[row] += residuals[row]
            slope[row + 6] += t * residuals[row]
            residuals[row] = 0.0
            for column in range(row + 1):
                product = products[row, column]
                information[row, column] += product
                information[row + 6, column] += t * product
                information[row + 6, column + 6] += t * t * product
                products[row, column] = 0.0
    for row in range(6):
        for column in range(row):
            for i, j in ((row, column), (row + 6, column + 6)):
                information[j, i] = information[i, j]
            information[column + 6, row] = information[row + 6, column]
    for row in range(6):
        for column in range(6):
            information[row, column + 6] = information[column + 6, row]
    return information, slope


@numba.njit(cache=True, nogil=True, error_model="numpy")
def information_by_edge(
    by_pose: FloatArray, after_s: FloatArray, weight: FloatArray, edge: IntArray, edge_count: int
) -> FloatArray:
    """(E, 12, 12) what the events of each edge contribute to `normal_equations`.

    Args:
        by_pose, after_s, weight: of `normal_equations`.
        edge: (K,) of each event.
        edge_count: E.
    """
    # By powers of the time: 1, t and t^2.
    sums = np.zeros((edge_count, 3, 6, 6))
    for k in range(len(weight)):
        if weight[k] == 0.0:
            continue
        of_edge, t = sums[edge[k]], after_s[k]
        for row in range(6):
            share = weight[k] * by_pose[k, row]
            for column in range(6):
                product = share * by_pose[k, column]
                of_edge[0, row, column] += product
                of_edge[1, row, column] += t * product
                of_edge[2, row, column] += t * t * product
    information = np.empty((edge_count, 12, 12))
    for row in range(6):
        for column in range(6):
            information[:, row, column] = sums[:, 0, row, column]
            information[:, row + 6, column] = sums[:, 1, row, column]
            information[:, row, column + 6] = sums[:, 1, row, column]
            information[:, row + 6, column + 6] = sums[:, 2, row, column]
    return information


@numba.njit(cache=True, nogil=True, error_model="numpy")
def support(
    xy_px: FloatArray,
    piece: Array,
    residual_px: FloatArray,
    images: FloatArray,
    inner_px: float,
    outer_px: tuple[float, float],
    bin_px: float,
) -> tuple[IntArray, IntArray, FloatArray]:
    """What events say for each piece.

    Args:
        xy_px: (K, 2) pixels of the picture (or near it; they say where along a piece an event is).
        piece: (K,) piece of each event.
        residual_px: (K,) distances from it.
        images: (P, 4) of the pieces.
        inner_px: events so near lie on the piece.
        outer_px: events between these two distances lie beside it.
        bin_px: length of a part of the piece.

    Returns:
        (P,) events on each piece, (P,) events beside it, and (P,) the share of its parts that has
        an event on it.
    """
    count = len(images)
    on, beside = np.zeros(count, np.int64), np.zeros(count, np.int64)
    parts = np.zeros(count, np.uint64)
    bin_count = np.ones(count, np.int64)
    for p in range(count):
        length = math.hypot(images[p, 2] - images[p, 0], images[p, 3] - images[p, 1])
        bin_count[p] = min(MAX_BIN_COUNT, max(1, math.ceil(length / bin_px)))
    for k in range(len(piece)):
        p = piece[k]
        away = abs(residual_px[k])
        if away < inner_px:
            on[p] += 1
            dx, dy = images[p, 2] - images[p, 0], images[p, 3] - images[p, 1]
            share = (xy_px[k, 0] - images[p, 0]) * dx + (xy_px[k, 1] - images[p, 1]) * dy
            share /= max(dx * dx + dy * dy, 1e-12)
            place = min(bin_count[p] - 1, max(0, int(share * bin_count[p])))
            parts[p] |= np.uint64(1) << np.uint64(place)
        elif outer_px[0] <= away < outer_px[1]:
            beside[p] += 1
    occupied = np.zeros(count)
    for p in range(count):
        set_count = 0
        for b in range(bin_count[p]):
            set_count += (parts[p] >> np.uint64(b)) & np.uint64(1)
        occupied[p] = set_count / bin_count[p]
    return on, beside, occupied
