"""Lines as seen from a place, in bits: where on the sphere they are, to be compared with arcs.

About the direction of its class a line takes up one bearing, and a stretch of elevations against
the plane across that direction, told as a word of 64 bits. A pane holds such a word for every class
and bearing: the arcs of a picture are painted on it once for each orientation, and every line of
the map is looked up there.
"""

from __future__ import annotations

import numba
import numpy as np

from roel_service.arrays import Array, FloatArray, IntArray

ELEVATION_BITS = 64
BITS_PER_RAD = ELEVATION_BITS / np.pi
# Lines reach so far beyond their ends, as an angle.
END_SLACK_RAD = np.deg2rad(1.5)
# A line through the place itself has any bearing.
MIN_DISTANCE_M = 1e-6


@numba.njit(cache=True, nogil=True, inline="always")
def _word(first_rad: float, last_rad: float) -> np.uint64:
    """Ones on the steps between two elevations."""
    first = max(0, int((first_rad + np.pi / 2) * BITS_PER_RAD))
    last = min(ELEVATION_BITS - 1, int((last_rad + np.pi / 2) * BITS_PER_RAD))
    ones = np.uint64(0xFFFFFFFFFFFFFFFF) >> np.uint64(ELEVATION_BITS - 1 - (last - first))
    return ones << np.uint64(first)


@numba.njit(cache=True, nogil=True, inline="always")
def _count(word: np.uint64) -> np.uint64:
    """Number of ones."""
    word = word - ((word >> np.uint64(1)) & np.uint64(0x5555555555555555))
    word = (word & np.uint64(0x3333333333333333)) + (
        (word >> np.uint64(2)) & np.uint64(0x3333333333333333)
    )
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return (word * np.uint64(0x0101010101010101)) >> np.uint64(56)


@numba.njit(cache=True, nogil=True, inline="always")
def _small_arctan(x: float) -> float:
    """Of 0 to 1, within 1e-5 rad."""
    q = x * x
    return x * (
        0.99997726
        + q
        * (-0.33262347 + q * (0.19354346 + q * (-0.11643287 + q * (0.05265332 - 0.01172120 * q))))
    )


@numba.njit(cache=True, nogil=True, inline="always")
def _arctan(value: float) -> float:
    """Within 1e-5 rad, in a third of the time; choices, as processors guess branches wrong."""
    size = abs(value)
    angle = _small_arctan(min(size, 1.0) / max(size, 1.0))
    angle = np.pi / 2 - angle if size > 1.0 else angle
    return angle if value >= 0.0 else -angle


@numba.njit(cache=True, nogil=True, inline="always")
def _bearing(across: float, aside: float) -> float:
    """0 to 2 pi."""
    x, y = abs(across), abs(aside)
    angle = _small_arctan(min(x, y) / max(x, y, 1e-300))
    angle = np.pi / 2 - angle if y > x else angle
    angle = np.pi - angle if across < 0.0 else angle
    return 2.0 * np.pi - angle if aside < 0.0 else angle


@numba.njit(cache=True, nogil=True)
def spans(feet: FloatArray, which: IntArray, inside: FloatArray) -> FloatArray:
    """(L,) angles that lines take up, seen from a place, (K, 3) in the axes of each class."""
    span_rad = np.empty(len(feet))
    for j in range(len(feet)):
        k = which[j]
        across, aside = feet[j, 0] - inside[k, 0], feet[j, 1] - inside[k, 1]
        away = max(np.sqrt(across * across + aside * aside), MIN_DISTANCE_M)
        low, high = (feet[j, 2] - inside[k, 2]) / away, (feet[j, 3] - inside[k, 2]) / away
        span_rad[j] = _arctan(high) - _arctan(low)
    return span_rad


@numba.njit(cache=True, nogil=True)
def widest(feet: FloatArray, which: IntArray, places: FloatArray, count: int) -> Array:
    """(T, C) int32 lines that take up most of the sphere from (T, K, 3) places, widest first."""
    count = min(count, len(feet))
    chosen = np.empty((len(places), count), np.int32)
    for t in range(len(places)):
        span_rad = spans(feet, which, places[t])
        least = np.partition(span_rad, len(feet) - count)[len(feet) - count] if count else np.inf
        wide = np.flatnonzero(span_rad >= least)
        chosen[t] = wide[np.argsort(-span_rad[wide], kind="mergesort")][:count]
    return chosen


@numba.njit(cache=True, nogil=True)
def _look(
    feet: FloatArray, j: int, inside: FloatArray, k: int, per_rad: float, bearing_count: int
) -> tuple[int, np.uint64, float]:
    """Step of the bearing of line j, its elevations, and the distance of its nearest point, m."""
    across, aside = feet[j, 0] - inside[k, 0], feet[j, 1] - inside[k, 1]
    low, high = feet[j, 2] - inside[k, 2], feet[j, 3] - inside[k, 2]
    away = max(np.sqrt(across * across + aside * aside), MIN_DISTANCE_M)
    bearing = min(int(_bearing(across, aside) * per_rad), bearing_count - 1)
    word = _word(_arctan(low / away) - END_SLACK_RAD, _arctan(high / away) + END_SLACK_RAD)
    ahead = max(0.0, low, -high)
    return bearing, word, np.sqrt(away * away + ahead * ahead)


@numba.njit(cache=True, nogil=True, inline="always")
def _shell(distance_m: float, shell_ends_m: FloatArray) -> int:
    shell = 0
    while shell < len(shell_ends_m) and distance_m > shell_ends_m[shell]:
        shell += 1
    return shell


@numba.njit(cache=True, nogil=True)
def views(
    feet: FloatArray,
    which: IntArray,
    places: FloatArray,
    chosen: Array,
    bearing_count: int,
    claim_bearing_count: int,
    shell_ends_m: FloatArray,
) -> tuple[Array, Array, Array, Array]:
    """Lines as seen from places.

    Args:
        feet: (L, 4) of each line in the axes of its class: across, across, least and greatest
            along, m.
        which: (L,) class of each line.
        places: (T, K, 3) in the axes of each class, m.
        chosen: (T, M) lines that are looked at from each place.
        bearing_count: B.
        claim_bearing_count: of what takes up the same steps of so many bearings, the first line
            alone is in front.
        shell_ends_m: (S - 1,) distances that part the shells.

    Returns:
        (T, M) uint16 slots: class and bearing as class B + bearing; (T, M) uint64 elevations, twice:
        all, and those in front; and (T, M) uint8 kinds: class and shell of the nearest point as
        class S + shell.
    """
    slots = np.empty(chosen.shape, np.uint16)
    words, fronts = np.empty(chosen.shape, np.uint64), np.empty(chosen.shape, np.uint64)
    kinds = np.empty(chosen.shape, np.uint8)
    per_rad, shell_count = bearing_count / (2.0 * np.pi), len(shell_ends_m) + 1
    claimed = np.zeros(places.shape[1] * bearing_count, np.uint64)
    for t in range(len(places)):
        claimed[:] = 0
        inside = places[t]
        for m in range(chosen.shape[1]):
            j = chosen[t, m]
            k = which[j]
            bearing, word, distance_m = _look(feet, j, inside, k, per_rad, bearing_count)
            claim = k * bearing_count + bearing - bearing % claim_bearing_count
            slots[t, m], words[t, m] = k * bearing_count + bearing, word
            fronts[t, m] = word & ~claimed[claim]
            claimed[claim] |= word
            kinds[t, m] = k * shell_count + _shell(distance_m, shell_ends_m)
    return slots, words, fronts, kinds


@numba.njit(cache=True, nogil=True)
def best_place(
    feet: FloatArray,
    which: IntArray,
    places: FloatArray,
    line_count: int,
    claim_bearing_count: int,
    shell_ends_m: FloatArray,
    pane: Array,
    shown: Array,
    weights: FloatArray,
    by_likelihood: bool,
) -> tuple[int, float]:
    """Which of places close to one another agrees best with a pane, and its score.

    Args:
        feet, which, claim_bearing_count, shell_ends_m: as `views` has them.
        places: (T, K, 3) in the axes of each class, m.
        line_count: that are looked at, those that are widest from the middle.
        pane, shown: (K, B) what is painted, and what the picture shows.
        weights: (3, N) of each kind of line: chance that a step is painted; what a painted step in
            front gains, and what one that is not loses.
        by_likelihood: which of the two scores.
    """
    middle = np.zeros(places.shape[1:])
    for t in range(len(places)):
        middle += places[t] / len(places)
    chosen = widest(feet, which, middle.reshape(1, -1, 3), line_count)[0]
    bearing_count, shell_count = pane.shape[1], len(shell_ends_m) + 1
    per_rad = bearing_count / (2.0 * np.pi)
    claimed = np.zeros(pane.shape, np.uint64)
    best, best_score = -1, -np.inf
    for t in range(len(places)):
        claimed[:] = 0
        inside = places[t]
        gained, size = 0.0, 0.0
        for m in range(len(chosen)):
            j = chosen[m]
            k = which[j]
            bearing, word, distance_m = _look(feet, j, inside, k, per_rad, bearing_count)
            if by_likelihood:
                claim = bearing - bearing % claim_bearing_count
                front = word & ~claimed[k, claim]
                if front == 0:
                    continue
                claimed[k, claim] |= word
                kind = k * shell_count + _shell(distance_m, shell_ends_m)
                gained += weights[1, kind] * np.float64(_count(front & pane[k, bearing]))
                gained += weights[2, kind] * np.float64(_count(front & shown[k, bearing]))
            else:
                steps = np.float64(_count(word & shown[k, bearing]))
                gained += np.float64(_count(word & pane[k, bearing]))
                gained -= weights[0, k * shell_count] * steps
                size += steps
        score = gained if by_likelihood else gained / np.sqrt(max(size, 1.0))
        if score > best_score:
            best, best_score = t, score
    return best, best_score


@numba.njit(cache=True, nogil=True)
def sizes(slots: Array, words: Array, kinds: Array, shown: Array, kind_count: int) -> FloatArray:
    """(T, N) steps that the lines of each kind take up, of those that (K B,) words show."""
    size = np.zeros((len(words), kind_count))
    for t in range(len(words)):
        for j in range(words.shape[1]):
            size[t, kinds[t, j]] += np.float64(_count(words[t, j] & shown[slots[t, j]]))
    return size


@numba.njit(cache=True, nogil=True)
def strokes(
    starts: FloatArray,
    ends: FloatArray,
    normals: FloatArray,
    rotation: FloatArray,
    frames: FloatArray,
    max_sine: float,
) -> tuple[IntArray, FloatArray, Array]:
    """(A,) class of each arc, -1 for none; (A,) bearing, rad, and (A,) uint64 elevations.

    Args:
        starts, ends, normals: (A, 3) unit, panorama frame.
        rotation: (3, 3) R_world_panorama.
        frames: (K, 3, 3) rows are the axes of each class, the last one its direction.
        max_sine: of the angle by which arcs may be off the direction of their class.
    """
    which, bearings = np.full(len(starts), -1, np.int64), np.zeros(len(starts))
    words = np.zeros(len(starts), np.uint64)
    turned = np.empty((len(frames), 3, 3))
    for k in range(len(frames)):
        turned[k] = frames[k] @ rotation
    for a in range(len(starts)):
        least, k = max_sine, -1
        for c in range(len(frames)):
            sine = abs(_along(turned, c, 2, normals, a))
            if sine < least:
                least, k = sine, c
        if k < 0:
            continue
        first_x, first_y = _along(turned, k, 0, starts, a), _along(turned, k, 1, starts, a)
        last_x, last_y = _along(turned, k, 0, ends, a), _along(turned, k, 1, ends, a)
        if first_x * last_x + first_y * last_y <= 0.0:
            continue  # over the vanishing point, where no line of the class goes
        # The bearing of the circle: ends near the vanishing point have none to speak of.
        across, aside = _along(turned, k, 1, normals, a), -_along(turned, k, 0, normals, a)
        if across * (first_x + last_x) + aside * (first_y + last_y) < 0.0:
            across, aside = -across, -aside
        low = np.arctan2(_along(turned, k, 2, starts, a), np.sqrt(first_x**2 + first_y**2))
        high = np.arctan2(_along(turned, k, 2, ends, a), np.sqrt(last_x**2 + last_y**2))
        which[a], bearings[a] = k, np.arctan2(aside, across) % (2.0 * np.pi)
        words[a] = _word(min(low, high), max(low, high))
    return which, bearings, words


@numba.njit(cache=True, nogil=True, inline="always")
def _along(frames: FloatArray, k: int, axis: int, rays: FloatArray, a: int) -> float:
    """Coordinate of ray a along an axis of frame k."""
    return float(
        frames[k, axis, 0] * rays[a, 0]
        + frames[k, axis, 1] * rays[a, 1]
        + frames[k, axis, 2] * rays[a, 2]
    )


@numba.njit(cache=True, nogil=True)
def paint(
    which: IntArray,
    bearings: FloatArray,
    words: Array,
    class_count: int,
    bearing_count: int,
    slack_rad: float,
) -> Array:
    """(K, B) uint64 pane of strokes, each painted so far to either side."""
    pane = np.zeros((class_count, bearing_count), np.uint64)
    per_rad = bearing_count / (2.0 * np.pi)
    for a in range(len(which)):
        if which[a] < 0:
            continue
        begin = int(np.floor((bearings[a] - slack_rad) * per_rad))
        end = int(np.floor((bearings[a] + slack_rad) * per_rad))
        for b in range(begin, end + 1):
            pane[which[a], b % bearing_count] |= words[a]
    return pane


@numba.njit(cache=True, nogil=True)
def paint_view(sides: FloatArray, frames: FloatArray, bearing_count: int) -> Array:
    """(K, B) uint64 pane of all that a photograph shows.

    Args:
        sides: (V, 3) unit, world; a ray is shown if it is on the positive side of each.
        frames: (K, 3, 3) as in `paint`.
        bearing_count: B.
    """
    pane = np.zeros((len(frames), bearing_count), np.uint64)
    for k in range(len(frames)):
        inside = sides @ frames[k].T
        for b in range(bearing_count):
            bearing = (b + 0.5) * (2.0 * np.pi / bearing_count)
            for e in range(ELEVATION_BITS):
                elevation = (e + 0.5) / BITS_PER_RAD - np.pi / 2
                x, y = np.cos(elevation) * np.cos(bearing), np.cos(elevation) * np.sin(bearing)
                z = np.sin(elevation)
                shown = True
                for v in range(len(inside)):
                    shown &= inside[v, 0] * x + inside[v, 1] * y + inside[v, 2] * z > 0.0
                if shown:
                    pane[k, b] |= np.uint64(1) << np.uint64(e)
    return pane


@numba.njit(cache=True, nogil=True)
def painted_share(pane: Array, shown: Array) -> FloatArray:
    """(K,) share of what is shown of each class's part of a pane that is painted."""
    share = np.zeros(len(pane))
    for k in range(len(pane)):
        whole = 0.0
        for b in range(pane.shape[1]):
            share[k] += _count(pane[k, b] & shown[k, b])
            whole += _count(shown[k, b])
        share[k] /= max(whole, 1.0)
    return share


@numba.njit(cache=True, nogil=True)
def painted_steps(
    slots: Array,
    words: Array,
    fronts: Array,
    kinds: Array,
    pane: Array,
    gains: FloatArray,
    chosen: IntArray,
) -> FloatArray:
    """(C, 2) steps of lines that are painted, and what those in front gain.

    Args:
        slots, words, fronts, kinds: (T, M) of `views`.
        pane: (K B,).
        gains: (N,) of a step of each kind.
        chosen: (C,) places that are asked for.
    """
    total = np.zeros((len(chosen), 2))
    for c in range(len(chosen)):
        t = chosen[c]
        steps, gained = np.uint64(0), 0.0
        for j in range(slots.shape[1]):
            both = words[t, j] & pane[slots[t, j]]
            steps += _count(both)
            gained += gains[kinds[t, j]] * np.float64(_count(both & fronts[t, j]))
        total[c, 0], total[c, 1] = np.float64(steps), gained
    return total
