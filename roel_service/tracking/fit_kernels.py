"""A fit of one window as one loop.

Each of its parts is short. Called one by one, two threads that fit beside each other would hand Python's
lock over hundreds of times a window, which takes longer than the work.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np

from roel_service.arrays import Array, BoolArray, FloatArray, IntArray
from roel_service.tracking.image_kernels import (
    NO_PIECE,
    distances,
    draw_nearest,
    event_weights,
    information_by_edge,
    normal_equations,
    pieces_near,
    project,
    retracted,
    support,
)

# In units of the scale of a round: events so near lie on a line, and those beside it.
INNER, BESIDE = 1.0, (2.0, 4.0)
# Tukey's weight ends here, in units of the scale.
REACH = 2.5
# Length of the parts of a piece of which it is asked whether they have events.
BIN_PX = 4.0
# A piece is seen when events lie on so many of its parts, and so much denser on it than beside it.
MIN_OCCUPIED = 0.5
MIN_DENSITY_RATIO = 1.6
# A piece shorter than this in the picture says nothing of what is seen.
MIN_LENGTH_PX = 8.0
# A line without events moves less than about so much across itself in a window. One that is foretold
# to move more than `REACH` times this is taken for hidden.
SILENT_PX = 1.0
# Steps of a round between two associations.
STEPS_PER_ROUND = 2


class Motion(NamedTuple):
    """A pose and what becomes of it.

    Attributes:
        rotation, centre: (3, 3), (3,) of `T_world_camera`.
        velocity: (6,) change (r, d) of the pose in a second.
    """

    rotation: FloatArray
    centre: FloatArray
    velocity: FloatArray


class Events(NamedTuple):
    """Events of a window.

    Attributes:
        xy_px: (K, 2) ideal pixels at the events' own times.
        slot: (K,) index into `slot_s`.
        slot_s: (S,) times of the slots, after that of the state.
        span_s: length of the window.
    """

    xy_px: FloatArray
    slot: IntArray
    slot_s: FloatArray
    span_s: float


class Pieces(NamedTuple):
    """Pieces of the map's lines.

    Attributes:
        segments: (P, 2, 3) m, world.
        direction: (P, 3) unit.
        edge: (P,) edge of the room that each is of.
        known: (P,) whether no events on it say that it rests, since it is not hidden.
        min_depth_m: what is nearer is cut.
    """

    segments: FloatArray
    direction: FloatArray
    edge: IntArray
    known: BoolArray
    min_depth_m: float


class Picture(NamedTuple):
    """Calibration, size, and how well lines and events are known in it.

    Attributes:
        K: (3, 3) px.
        width, height: px.
        line_noise_px, line_noise_m: deviation of a line as a whole, in the picture and in the map.
        event_noise: deviation of an event, in units of the scale of a round.
    """

    K: FloatArray
    width: int
    height: int
    line_noise_px: float
    line_noise_m: float
    event_noise: float


class _Near(NamedTuple):
    """Events beside the lines that are near them in the picture of one pose.

    Attributes:
        images: (P, 4) of `project`.
        line_px2: (P,) variance of each image.
        xy_px, slot, piece, after_s: (N, 2), (N,) of the events.
    """

    images: FloatArray
    line_px2: FloatArray
    xy_px: FloatArray
    slot: IntArray
    piece: Array
    after_s: FloatArray


class Fitted(NamedTuple):
    """What a window says of its state.

    Attributes:
        step: (12,) from the forecast to the state.
        covariance: (12, 12) of the state.
        information: (12, 12) what the window says of a step of the state.
        information_of_edges: (E, 12, 12) what the edges that have events say each.
        seen: (P,) whether events lie along each piece.
        on_count, beside_count: (P,) events on each piece and beside it, at the state.
        is_dense: (P,) `seen` at the state.
        length_px: (P,) what is seen of each piece.
        speed_px_per_s: (P,) speed of each image across itself, in its middle.
    """

    step: FloatArray
    covariance: Array
    information: FloatArray
    information_of_edges: FloatArray
    seen: BoolArray
    on_count: IntArray
    beside_count: IntArray
    is_dense: BoolArray
    length_px: FloatArray
    speed_px_per_s: FloatArray


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fitted(
    forecast: Motion,
    prior_information: FloatArray,
    events: Events,
    pieces: Pieces,
    picture: Picture,
    scales_px: FloatArray,
) -> Fitted:
    """Iterated least squares: the step from the forecast that suits events and forecast best.

    Args:
        prior_information: (12, 12) of the forecast.
        scales_px: (R,) of the rounds, each with an association of its own.
    """
    step = np.zeros(12)
    motion = forecast
    for scale_px in scales_px:
        near = _near(motion, events, pieces, picture, scale_px)
        event_px2 = (picture.event_noise * scale_px) ** 2
        length_px = _lengths_px(near.images)
        for _ in range(STEPS_PER_ROUND):
            residual_px, by_pose = _distances(motion, near, events.slot_s, pieces, picture)
            on, beside, occupied = _support(near, residual_px, scale_px)
            seen = _are_seen(on, beside, occupied)
            weight = event_weights(
                residual_px,
                near.piece,
                seen & (length_px >= MIN_LENGTH_PX),
                near.line_px2,
                event_px2,
                REACH * scale_px,
            )
            information, slope = normal_equations(residual_px, by_pose, near.after_s, weight)
            silent = pieces.known & ~seen & (length_px >= MIN_LENGTH_PX)
            _add_silence(information, slope, motion, near, silent, pieces, picture, events.span_s)
            covariance = np.linalg.inv(information + prior_information)
            step = step - covariance @ (slope + prior_information @ step)
            motion = _stepped(forecast, step)
    residual_px, _ = _distances(motion, near, events.slot_s, pieces, picture)
    on, beside, occupied = _support(near, residual_px, scale_px)
    moving, by_step = _by_pose(motion, near.images, length_px > 0.0, pieces, picture)
    speed_px_per_s = np.zeros(len(length_px))
    for n, p in enumerate(moving):
        for i in range(6):
            speed_px_per_s[p] += by_step[n, i] * motion.velocity[i]
    return Fitted(
        step,
        covariance,
        information,
        _information_of_edges(near, by_pose, weight, pieces.edge),
        seen,
        on,
        beside,
        _are_seen(on, beside, occupied),
        length_px,
        np.abs(speed_px_per_s),
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _stepped(motion: Motion, step: FloatArray) -> Motion:
    """With pose and velocity changed by (12,)."""
    rotations, centres = retracted(motion.rotation, motion.centre, step[:6].reshape(1, 6))
    return Motion(rotations[0], centres[0], motion.velocity + step[6:])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _poses(motion: Motion, after_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(N, 3, 3) rotations and (N, 3) centres so many seconds later, were the motion even."""
    steps = np.empty((len(after_s), 6))
    for n in range(len(after_s)):
        for i in range(6):
            steps[n, i] = after_s[n] * motion.velocity[i]
    return retracted(motion.rotation, motion.centre, steps)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _near(
    motion: Motion, events: Events, pieces: Pieces, picture: Picture, scale_px: float
) -> _Near:
    """Events within the largest distance that a round asks for."""
    images, depths_m = project(
        pieces.segments,
        motion.rotation,
        motion.centre,
        picture.K,
        picture.width,
        picture.height,
        pieces.min_depth_m,
    )
    nearest = draw_nearest(images, BESIDE[1] * scale_px, picture.width, picture.height)
    turns = _turns(motion, events.slot_s)
    of_all = pieces_near(events.xy_px, events.slot, turns, picture.K, nearest)
    chosen = np.flatnonzero(of_all != NO_PIECE)
    xy_px, slot = np.empty((len(chosen), 2)), np.empty(len(chosen), np.int64)
    piece, after_s = np.empty(len(chosen), np.int32), np.empty(len(chosen))
    for n, k in enumerate(chosen):
        xy_px[n, 0], xy_px[n, 1] = events.xy_px[k, 0], events.xy_px[k, 1]
        slot[n], piece[n] = events.slot[k], of_all[k]
        after_s[n] = events.slot_s[slot[n]]
    return _Near(images, _line_variances_px2(depths_m, picture), xy_px, slot, piece, after_s)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _turns(motion: Motion, slot_s: FloatArray) -> FloatArray:
    """(S, 3, 3) rotations from the camera at the slots to the camera at the time of the state."""
    rotations, _ = _poses(motion, slot_s)
    turns = np.zeros((len(slot_s), 3, 3))
    for s in range(len(slot_s)):
        for i in range(3):
            for j in range(3):
                for row in range(3):
                    turns[s, i, j] += motion.rotation[row, i] * rotations[s, row, j]
    return turns


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _line_variances_px2(depths_m: FloatArray, picture: Picture) -> FloatArray:
    """(P,) variance of a line as a whole: in the picture, and in the map at its depth."""
    variances_px2 = np.full(len(depths_m), picture.line_noise_px**2)
    for p in range(len(depths_m)):
        if depths_m[p] > 0.0:
            variances_px2[p] += (picture.line_noise_m * picture.K[0, 0] / depths_m[p]) ** 2
    return variances_px2


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _lengths_px(images: FloatArray) -> FloatArray:
    lengths_px = np.empty(len(images))
    for p in range(len(images)):
        lengths_px[p] = math.hypot(images[p, 2] - images[p, 0], images[p, 3] - images[p, 1])
    return lengths_px


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _distances(
    motion: Motion, near: _Near, slot_s: FloatArray, pieces: Pieces, picture: Picture
) -> tuple[FloatArray, FloatArray]:
    """(N,) distances (px) and (N, 6) derivatives by a step of the pose at the event's time."""
    rotations, centres = _poses(motion, slot_s)
    return distances(
        near.xy_px,
        near.slot,
        near.piece,
        rotations,
        centres,
        picture.K,
        pieces.segments,
        pieces.direction,
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _support(
    near: _Near, residual_px: FloatArray, scale_px: float
) -> tuple[IntArray, IntArray, FloatArray]:
    """For each piece (P,) events on it, beside it, and the share of its parts with events."""
    outer_px = (BESIDE[0] * scale_px, BESIDE[1] * scale_px)
    return support(
        near.xy_px, near.piece, residual_px, near.images, INNER * scale_px, outer_px, BIN_PX
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _are_seen(on: IntArray, beside: IntArray, occupied: FloatArray) -> BoolArray:
    """(P,) whether events lie along each piece, and denser than beside it."""
    density = on / (2.0 * INNER)
    density_beside = beside / (2.0 * (BESIDE[1] - BESIDE[0]))
    return (occupied >= MIN_OCCUPIED) & (density > MIN_DENSITY_RATIO * density_beside)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _by_pose(
    motion: Motion, images: FloatArray, chosen: BoolArray, pieces: Pieces, picture: Picture
) -> tuple[Array, FloatArray]:
    """(N,) int32 chosen pieces, and (N, 6) how their images go across themselves when the pose steps, px."""
    piece = np.flatnonzero(chosen).astype(np.int32)
    middles_px = np.empty((len(piece), 2))
    for n, p in enumerate(piece):
        middles_px[n, 0] = 0.5 * (images[p, 0] + images[p, 2])
        middles_px[n, 1] = 0.5 * (images[p, 1] + images[p, 3])
    _, by_pose = distances(
        middles_px,
        np.zeros(len(piece), np.int64),
        piece,
        motion.rotation.copy().reshape(1, 3, 3),
        motion.centre.copy().reshape(1, 3),
        picture.K,
        pieces.segments,
        pieces.direction,
    )
    return piece, by_pose


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_silence(
    information: FloatArray,
    slope: FloatArray,
    motion: Motion,
    near: _Near,
    silent: BoolArray,
    pieces: Pieces,
    picture: Picture,
    span_s: float,
) -> None:
    """Add what lines without events say, which is that they do not move across themselves.

    Where all lines of a direction rest in the picture, nothing else holds the motion across them.
    """
    chosen, by_pose = _by_pose(motion, near.images, silent, pieces, picture)
    for n in range(len(chosen)):
        by_velocity = span_s * by_pose[n]
        motion_px = 0.0
        for i in range(6):
            motion_px += by_velocity[i] * motion.velocity[i]
        share = max(0.0, 1.0 - (motion_px / (REACH * SILENT_PX)) ** 2)
        # They rest for one reason, and together say no more than one of them does.
        weight = share**2 / (SILENT_PX**2 * len(chosen))
        for i in range(6):
            slope[6 + i] += weight * by_velocity[i] * motion_px
            for j in range(6):
                information[6 + i, 6 + j] += weight * by_velocity[i] * by_velocity[j]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _information_of_edges(
    near: _Near, by_pose: FloatArray, weight: FloatArray, edge: IntArray
) -> FloatArray:
    """(E, 12, 12) information of each edge that has events."""
    of_event = edge[near.piece]
    place = np.full(len(edge), -1)
    count = 0
    for k in range(len(of_event)):
        if place[of_event[k]] < 0:
            place[of_event[k]] = count
            count += 1
    return information_by_edge(by_pose, near.after_s, weight, place[of_event], count)
