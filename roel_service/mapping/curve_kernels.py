"""Loops over points of curves and the pieces of edges that were seen beside their images.

A point is given by the direction from a camera centre and an inverse depth, which may be small: its
place in another camera is found without ever dividing by it. A piece of another frame fits where
the point's image lies beside it and its normal speed is that of a point at this depth.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from roel_service.arrays import Array

# A piece reaches this far beyond its ends, px: there are gaps between the pieces of an edge.
REACH_PX = 2.0
# A residual below this counts as support, px.
SUPPORT_PX = 1.0
# Hypotheses of one point, each a pixel of disparity from the next.
MAX_HYPOTHESIS_COUNT = 400
# Steps from the best hypothesis on, and how the gate narrows with each, down to the least, px.
DEPTH_ITERATION_COUNT = 6
GATE_SHRINK = 0.8
MIN_GATE_PX = 1.0
# Cosine of the largest angle between a piece and the image of the curve.
MIN_FACING = 0.85
NO_VECTOR = np.zeros(3)
# Answers of `fitting_piece`: the point is in view but nothing fits; it is not in view.
NOTHING, OUT_OF_VIEW = -1, -2


class Field(NamedTuple):
    """Pieces of all frames by place, and the cameras.

    Attributes:
        start, members: the pieces of cell c are members[start[c]:start[c + 1]]; cells run over
            frames, rows and columns.
        rows, columns, cell_px: of the cells of one frame.
        middle: (M, 2) of each piece, px.
        direction: (M, 2) unit vectors.
        half: (M,) px.
        speed: (M,) along the left-hand normal, px/ms.
        rotation: (N, 3, 3) `R_world_camera`.
        centre: (N, 3) camera centres, m, world.
        velocity: (N, 3) of the camera in its own frame, m/ms.
        fx, fy, cx, cy, width, height: calibration, px.
        max_speed_difference: observed against predicted, px/ms.
    """

    start: Array
    members: Array
    rows: int
    columns: int
    cell_px: float
    middle: Array
    direction: Array
    half: Array
    speed: Array
    rotation: Array
    centre: Array
    velocity: Array
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    max_speed_difference: float


@numba.njit(cache=True, nogil=True)
def place_in_cells(
    frame: Array,
    segments: Array,
    frame_count: int,
    rows: int,
    columns: int,
    cell_px: float,
    margin_px: float,
) -> tuple[Array, Array]:
    """`start` and `members` of `Field`: each piece in all cells that it comes within a margin of."""
    start = np.zeros(frame_count * rows * columns + 1, np.int64)
    members = np.empty(0, np.int64)
    for counting in (True, False):
        if not counting:
            start = np.cumsum(start)
            members = np.empty(start[-1], np.int64)
        place = start.copy()
        for m in range(len(segments)):
            x0, y0, x1, y1 = (
                segments[m, 0, 0],
                segments[m, 0, 1],
                segments[m, 1, 0],
                segments[m, 1, 1],
            )
            length = np.sqrt((x1 - x0) ** 2 + (y1 - y0) ** 2)
            dx, dy = (x1 - x0) / length, (y1 - y0) / length
            first_column = max(0, int(np.floor((min(x0, x1) - margin_px) / cell_px)))
            last_column = min(columns - 1, int(np.floor((max(x0, x1) + margin_px) / cell_px)))
            first_row = max(0, int(np.floor((min(y0, y1) - margin_px) / cell_px)))
            last_row = min(rows - 1, int(np.floor((max(y0, y1) + margin_px) / cell_px)))
            for row in range(first_row, last_row + 1):
                for column in range(first_column, last_column + 1):
                    ex = (column + 0.5) * cell_px - 0.5 * (x0 + x1)
                    ey = (row + 0.5) * cell_px - 0.5 * (y0 + y1)
                    # No point of a cell is farther from its middle than half a diagonal.
                    if abs(ex * dy - ey * dx) > margin_px + 0.7072 * cell_px:
                        continue
                    cell = (frame[m] * rows + row) * columns + column
                    if counting:
                        start[cell + 1] += 1
                    else:
                        members[place[cell]] = m
                        place[cell] += 1
    return start, members


@numba.njit(cache=True, nogil=True)
def into_camera(
    field: Field, frame: int, origin: Array, scale: float, vector: Array
) -> tuple[float, float, float]:
    """`vector + scale (origin - camera centre)`, all world, in the axes of one camera.

    Written out: arrays made in the innermost loop would take most of the time.
    """
    R, centre = field.rotation, field.centre
    a = vector[0] + scale * (origin[0] - centre[frame, 0])
    b = vector[1] + scale * (origin[1] - centre[frame, 1])
    c = vector[2] + scale * (origin[2] - centre[frame, 2])
    return (
        R[frame, 0, 0] * a + R[frame, 1, 0] * b + R[frame, 2, 0] * c,
        R[frame, 0, 1] * a + R[frame, 1, 1] * b + R[frame, 2, 1] * c,
        R[frame, 0, 2] * a + R[frame, 1, 2] * b + R[frame, 2, 2] * c,
    )


@numba.njit(cache=True, nogil=True)
def fitting_piece(
    field: Field, frame: int, x: float, y: float, inverse_depth: float, max_distance: float
) -> tuple[float, int]:
    """Signed distance of a point from the piece nearest to its image, px, and that piece.

    Args:
        x, y: normalised image position.
        inverse_depth: 1/m, for the speed.
        max_distance: px.
    """
    u, v = field.fx * x + field.cx, field.fy * y + field.cy
    if not (0.0 <= u < field.width and 0.0 <= v < field.height):
        return 0.0, OUT_OF_VIEW
    # Pixels per ms of a point that stands still while the camera moves but does not turn.
    w = field.velocity[frame]
    rate_u = field.fx * inverse_depth * (x * w[2] - w[0])
    rate_v = field.fy * inverse_depth * (y * w[2] - w[1])
    cell = (frame * field.rows + int(v / field.cell_px)) * field.columns + int(u / field.cell_px)
    nearest, offset, piece = max_distance, 0.0, NOTHING
    for place in range(field.start[cell], field.start[cell + 1]):
        m = field.members[place]
        dx, dy = field.direction[m, 0], field.direction[m, 1]
        ex, ey = u - field.middle[m, 0], v - field.middle[m, 1]
        if abs(ex * dx + ey * dy) > field.half[m] + REACH_PX:
            continue
        s = ey * dx - ex * dy
        if abs(s) >= nearest:
            continue
        if abs(rate_v * dx - rate_u * dy - field.speed[m]) > field.max_speed_difference:
            continue
        nearest, offset, piece = abs(s), s, m
    return offset, piece


@numba.njit(cache=True, nogil=True)
def find_depths(
    field: Field,
    own_frame: int,
    others: Array,
    rays: Array,
    low: Array,
    high: Array,
    step: float,
    max_distance: float,
) -> tuple[Array, Array, Array]:
    """The inverse depth of each point of one frame that most other frames agree with.

    Args:
        others: (J,) frames that are asked.
        rays: (n, 3) world vectors from the camera centre with a depth of 1.
        low, high: (n,) range of inverse depths, 1/m.
        step: 1/m, of a pixel of disparity at the most.
        max_distance: of a point's image from a piece, px.

    Returns:
        Inverse depths (n,), their information (n,) in px^2 m^2, 0 for a point that nothing fits,
        and how many frames support each, (n,).
    """
    origin = field.centre[own_frame]
    inverse_depths = np.zeros(len(rays))
    information = np.zeros(len(rays))
    support = np.zeros(len(rays), np.int64)
    for k in range(len(rays)):
        count = min(MAX_HYPOTHESIS_COUNT, max(2, int((high[k] - low[k]) / step) + 1))
        best_score, guess = 0.0, 0.0
        for index in range(count):
            rho = low[k] + index * step
            score = 0.0
            for frame in others:
                x, y, z = into_camera(field, frame, origin, rho, rays[k])
                if z <= 0.0:
                    continue
                s, piece = fitting_piece(field, frame, x / z, y / z, rho / z, max_distance)
                if piece >= 0:
                    score += 1.0 - (s / max_distance) ** 2
            if score > best_score:
                best_score, guess = score, rho
        if best_score > 0.0:
            inverse_depths[k], information[k], support[k] = refined_depth(
                field, own_frame, others, rays[k], guess, step, max_distance
            )
    return inverse_depths, information, support


@numba.njit(cache=True, nogil=True)
def refined_depth(
    field: Field,
    own_frame: int,
    others: Array,
    ray: Array,
    guess: float,
    step: float,
    max_distance: float,
) -> tuple[float, float, int]:
    """Gauss-Newton on one inverse depth with Tukey weights; arguments as in `find_depths`."""
    origin = field.centre[own_frame]
    rho, gate = guess, max_distance
    information, support = 0.0, 0
    for iteration in range(DEPTH_ITERATION_COUNT):
        information, gradient, support = 0.0, 0.0, 0
        for frame in others:
            x, y, z = into_camera(field, frame, origin, rho, ray)
            if z <= 0.0:
                continue
            x, y = x / z, y / z
            s, piece = fitting_piece(field, frame, x, y, rho / z, gate)
            if piece < 0:
                continue
            bx, by, bz = into_camera(field, frame, origin, 1.0, NO_VECTOR)
            rate_u, rate_v = field.fx * (bx - x * bz) / z, field.fy * (by - y * bz) / z
            rate = rate_v * field.direction[piece, 0] - rate_u * field.direction[piece, 1]
            weight = (1.0 - (s / gate) ** 2) ** 2
            information += weight * rate * rate
            gradient += weight * rate * s
            support += abs(s) < SUPPORT_PX
        if information <= 0.0 or iteration == DEPTH_ITERATION_COUNT - 1:
            break
        rho += min(step, max(-step, -gradient / information))
        gate = max(MIN_GATE_PX, GATE_SHRINK * gate)
    return rho, information, support


@numba.njit(cache=True, nogil=True)
def gather_evidence(
    field: Field, frames: Array, points: Array, tangents: Array, max_distance: float
) -> tuple[Array, Array, Array, Array, Array]:
    """What all frames say about points of a curve.

    Args:
        frames: (J,) frames that are asked.
        points: (n, 3) m, world.
        tangents: (n, 3) unit vectors along the curve.
        max_distance: of a point's image from a piece, px.

    Returns:
        information: (n, 3, 3) sum of w g g^T, g the rate of the residual, px/m.
        gradient: (n, 3) sum of w g s.
        support: (n,) frames with a residual below `SUPPORT_PX`.
        in_view: (n,) frames that have the point in their image.
        mean_square: (n,) weighted mean of the squared residuals, px^2.
    """
    information = np.zeros((len(points), 3, 3))
    gradient = np.zeros((len(points), 3))
    support = np.zeros(len(points), np.int64)
    in_view = np.zeros(len(points), np.int64)
    mean_square = np.zeros(len(points))
    rate = np.empty(3)
    for k in range(len(points)):
        total = 1e-12
        for frame in frames:
            x, y, z = into_camera(field, frame, points[k], 1.0, NO_VECTOR)
            if z <= 0.0:
                continue
            x, y = x / z, y / z
            s, piece = fitting_piece(field, frame, x, y, 1.0 / z, max_distance)
            in_view[k] += piece != OUT_OF_VIEW
            if piece < 0:
                continue
            dx, dy = field.direction[piece, 0], field.direction[piece, 1]
            tx, ty, tz = into_camera(field, frame, tangents[k], 0.0, tangents[k])
            along_u, along_v = field.fx * (tx - x * tz), field.fy * (ty - y * tz)
            along = np.sqrt(along_u * along_u + along_v * along_v)
            if abs(along_u * dx + along_v * dy) < MIN_FACING * along:
                continue
            # Rates of the residual along the camera's axes, then along the world's.
            by_x, by_y = -dy * field.fx / z, dx * field.fy / z
            by_z = -(by_x * x + by_y * y)
            R = field.rotation
            for i in range(3):
                rate[i] = R[frame, i, 0] * by_x + R[frame, i, 1] * by_y + R[frame, i, 2] * by_z
            weight = (1.0 - (s / max_distance) ** 2) ** 2
            for i in range(3):
                gradient[k, i] += weight * s * rate[i]
                for j in range(3):
                    information[k, i, j] += weight * rate[i] * rate[j]
            support[k] += abs(s) < SUPPORT_PX
            mean_square[k] += weight * s * s
            total += weight
        mean_square[k] /= total
    return information, gradient, support, in_view, mean_square
