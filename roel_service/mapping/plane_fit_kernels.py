"""Loops over the events near each detected line: gather, vote, fit, walk.

Symbols: a seed has mid-point q, unit direction d and left-hand normal (-d_y, d_x). An event has
u = d.(x - q) and s = normal.(x - q) in px, and tau in ms since the frame. The space-time plane is
s = alpha + beta u + gamma tau; gamma is the normal speed in px/ms.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from roel_service.arrays import Array

# The vote: events looked at, bin width (px), and how much a pixel of offset costs.
VOTE_EVENT_COUNT = 1200
VOTE_BIN_PX = 0.5
VOTE_OFFSET_COST_PER_PX = 0.04
# Robust least squares: rounds, widest residual of each of the two passes, and its shrinking.
FIT_ITERATION_COUNT = 6
FIRST_PASS_PX = 2.0
SECOND_PASS_PX = 1.5
RESIDUAL_SHRINK = 0.8
# The second pass looks this much farther than the first.
SECOND_GATHER = 1.3
# Pull of gamma to the vote in the first step, and the ridge that keeps the system regular when
# all events have the same time; both in units of one event at 1 ms.
VOTE_PRIOR = 1e3
SPEED_RIDGE = 1e-3
# A fit that turned, moved or sped up this much has left its seed.
MAX_TURN = 0.12
# Events of a line: closer than NEAR_PX; of its surroundings: up to FAR_PX.
NEAR_PX = 1.0
FAR_PX = 4.0
# Density that counts as empty surroundings, events for each px of length.
EMPTY_DENSITY_PER_PX = 0.02
MIN_EVENTS_PER_PX = 0.5
# A frame has fewer events.
MAX_EVENT_COUNT = 2**32
# Cosine of the largest turn of a random plane's slice against its seed: 60 degrees.
MIN_FACING = 0.5
# Length of the image part of a unit normal below which a plane is an instant, not a moving line.
MIN_IMAGE_PART = 1e-3


class Grid(NamedTuple):
    """Events of one frame, sorted by cells, a polarity each: cell c has start[c] to start[c+1].

    The events of a cell lie side by side in memory, because every line looks through many.

    Attributes:
        start: (2 * rows * columns + 1,) int64; the positive cells follow the negative ones.
        order: (K,) int64 index of each sorted event in the frame.
        xy_px: (K, 2) float32, sorted.
        tau_ms: (K,) float64 against the frame's time, sorted.
        rows, columns: cells.
        cell_px: side of a cell.
    """

    start: Array
    order: Array
    xy_px: Array
    tau_ms: Array
    rows: int
    columns: int
    cell_px: float


class VoteSettings(NamedTuple):
    """Plain numbers of `PlaneFitConfig` for the kernels."""

    candidate_distance_px: float
    extension_px: float
    max_speed_px_per_ms: float
    speed_count: int
    inlier_distance_px: float
    support_bin_px: float
    max_gap_bin_count: int
    min_occupancy: float
    min_density_ratio: float


class Local(NamedTuple):
    """Frame of a line: mid-point, unit direction, half length, all px."""

    qx: float
    qy: float
    dx: float
    dy: float
    half: float


@numba.njit(cache=True, nogil=True)
def grid_events(
    xy_px: Array, polarity: Array, rows: int, columns: int, cell_px: float
) -> tuple[Array, Array]:
    """Sort events into cells by counting; events outside the image go nowhere.

    Returns:
        start and order of `Grid`.
    """
    cell_count = rows * columns
    start = np.zeros(2 * cell_count + 1, np.int64)
    cells = np.full(len(xy_px), -1, np.int64)
    for k in range(len(xy_px)):
        column = np.floor(xy_px[k, 0] / cell_px)
        row = np.floor(xy_px[k, 1] / cell_px)
        if 0 <= column < columns and 0 <= row < rows:
            side = cell_count if polarity[k] > 0 else 0
            cells[k] = side + int(row) * columns + int(column)
            start[cells[k] + 1] += 1
    start = np.cumsum(start)
    place = start.copy()
    order = np.empty(start[-1], np.int64)
    for k in range(len(xy_px)):
        if cells[k] >= 0:
            order[place[cells[k]]] = k
            place[cells[k]] += 1
    return start, order


@numba.njit(cache=True, nogil=True)
def local_frame(segment: Array) -> Local:
    """Frame of a (2, 2) segment."""
    dx, dy = segment[1, 0] - segment[0, 0], segment[1, 1] - segment[0, 1]
    length = np.sqrt(dx * dx + dy * dy)
    qx, qy = 0.5 * (segment[0, 0] + segment[1, 0]), 0.5 * (segment[0, 1] + segment[1, 1])
    return Local(qx, qy, dx / length, dy / length, 0.5 * length)


@numba.njit(cache=True, nogil=True)
def gather(
    local: Local, max_s: float, max_u: float, side: int, grid: Grid, near: Array
) -> tuple[Array, int]:
    """The events of one polarity with |s| < max_s and |u| < max_u, by their place in the grid.

    Args:
        side: 0 for negative, 1 for positive.
        near: (n,) int64 buffer, grown where it is too small.

    Returns:
        The buffer and the number of places in it.
    """
    reach_x = abs(local.dx) * max_u + abs(local.dy) * max_s
    reach_y = abs(local.dy) * max_u + abs(local.dx) * max_s
    first_column = max(0, int(np.floor((local.qx - reach_x) / grid.cell_px)))
    last_column = min(grid.columns - 1, int(np.floor((local.qx + reach_x) / grid.cell_px)))
    first_row = max(0, int(np.floor((local.qy - reach_y) / grid.cell_px)))
    last_row = min(grid.rows - 1, int(np.floor((local.qy + reach_y) / grid.cell_px)))
    # No event of a cell is farther from its middle than half a diagonal.
    margin = max_s + 0.7072 * grid.cell_px
    count = 0
    for row in range(first_row, last_row + 1):
        for column in range(first_column, last_column + 1):
            mx = (column + 0.5) * grid.cell_px - local.qx
            my = (row + 0.5) * grid.cell_px - local.qy
            if abs(mx * local.dy - my * local.dx) > margin:
                continue
            cell = (side * grid.rows + row) * grid.columns + column
            first, last = grid.start[cell], grid.start[cell + 1]
            while count + last - first > len(near):
                near = np.concatenate((near, np.empty_like(near)))
            for k in range(first, last):
                ex, ey = grid.xy_px[k, 0] - local.qx, grid.xy_px[k, 1] - local.qy
                u = ex * local.dx + ey * local.dy
                s = ey * local.dx - ex * local.dy
                # Written in any case: nothing foretells which events are in, and a wrong guess costs more.
                near[count] = k
                count += (abs(s) < max_s) & (abs(u) < max_u)
    return near, count


@numba.njit(cache=True, nogil=True)
def local_coordinates(local: Local, near: Array, grid: Grid) -> tuple[Array, Array, Array]:
    """u, s and tau of the events `near`, (n,) float64 each."""
    u, s, tau = np.empty(len(near)), np.empty(len(near)), np.empty(len(near))
    for i in range(len(near)):
        k = near[i]
        ex, ey = grid.xy_px[k, 0] - local.qx, grid.xy_px[k, 1] - local.qy
        u[i] = ex * local.dx + ey * local.dy
        s[i] = ey * local.dx - ex * local.dy
        tau[i] = grid.tau_ms[k]
    return u, s, tau


@numba.njit(cache=True, nogil=True)
def vote_speed(
    half: float, u: Array, s: Array, tau: Array, settings: VoteSettings
) -> tuple[float, float]:
    """(alpha, gamma) for which most events fall into two neighbouring bins of s - gamma tau.

    Every other speed is tried first, then the two beside the best one.
    """
    stride = 1 + len(u) // VOTE_EVENT_COUNT
    # In bins, from the lower end of the range on.
    position, rate = np.empty(len(u) // stride + 1), np.empty(len(u) // stride + 1)
    chosen = 0
    for k in range(0, len(u), stride):
        position[chosen] = (s[k] + settings.candidate_distance_px) / VOTE_BIN_PX
        rate[chosen] = tau[k] / VOTE_BIN_PX
        chosen += abs(u[k]) <= half + 2.0
    position, rate, place = position[:chosen], rate[:chosen], np.empty(chosen, np.int32)
    # One bin more at either end, for what lies outside.
    counts = np.empty(int(2.0 * settings.candidate_distance_px / VOTE_BIN_PX) + 2, np.int32)
    step = 2.0 * settings.max_speed_px_per_ms / (settings.speed_count - 1)
    best, best_alpha, best_index = -1.0, 0.0, 0
    for index in range(0, settings.speed_count, 2):
        gamma = index * step - settings.max_speed_px_per_ms
        score, alpha = strongest_bins(position, rate, gamma, settings, place, counts)
        if score > best:
            best, best_alpha, best_index = score, alpha, index
    coarse = best_index
    for index in (coarse - 1, coarse + 1):
        if 0 <= index < settings.speed_count:
            gamma = index * step - settings.max_speed_px_per_ms
            score, alpha = strongest_bins(position, rate, gamma, settings, place, counts)
            if score > best:
                best, best_alpha, best_index = score, alpha, index
    return best_alpha, best_index * step - settings.max_speed_px_per_ms


@numba.njit(cache=True, nogil=True)
def strongest_bins(
    position: Array,
    rate: Array,
    gamma: float,
    settings: VoteSettings,
    place: Array,
    counts: Array,
) -> tuple[float, float]:
    """Score and offset (px) of the two neighbouring bins that most events fall into.

    Args:
        position, rate: (n,) bins at tau = 0, and bins for each px/ms of speed.
        gamma: speed, px/ms.
        place: (n,) int32 buffer.
        counts: buffer with one number a bin, and one more at either end.
    """
    bin_count = len(counts) - 2
    # A loop of arithmetic alone runs on several events at a time.
    for k in range(len(position)):
        shifted = position[k] - gamma * rate[k] + 1.0
        place[k] = int(min(max(shifted, 0.0), bin_count + 1.0))
    counts[:] = 0
    for k in range(len(position)):
        counts[place[k]] += 1
    best, best_alpha = -1.0, 0.0
    for first in range(1, bin_count):
        alpha = first * VOTE_BIN_PX - settings.candidate_distance_px
        pair = counts[first] + counts[first + 1]
        score = pair * (1.0 - VOTE_OFFSET_COST_PER_PX * abs(alpha))
        if score > best:
            best, best_alpha = score, alpha
    return best, best_alpha


@numba.njit(cache=True, nogil=True)
def fit_robust(
    u: Array, s: Array, tau: Array, plane: Array, first_px: float, last_px: float
) -> int:
    """Least squares on (alpha, beta, gamma) with Tukey weights of shrinking width.

    Args:
        plane: (3,) first guess, overwritten by the result.
        first_px, last_px: width of the weights at the start and at the end.

    Returns:
        How many events had a weight in the last step; 0 if the system was singular.
    """
    width = first_px
    voted = plane[2]
    inliers = 0
    normal = np.empty((3, 3))
    right = np.empty(3)
    for iteration in range(FIT_ITERATION_COUNT):
        inliers = weighted_sums(u, s, tau, plane, width, normal, right)
        if inliers < 3:
            return 0
        prior = VOTE_PRIOR if iteration == 0 else SPEED_RIDGE
        normal[2, 2] += prior
        right[2] += prior * voted
        if not solve_3x3(normal, right, plane):
            return 0
        if width == last_px:
            break
        width = max(width * RESIDUAL_SHRINK, last_px)
    return inliers


@numba.njit(cache=True, nogil=True)
def weighted_sums(
    u: Array, s: Array, tau: Array, plane: Array, width: float, normal: Array, right: Array
) -> int:
    """Normal equations of (alpha, beta, gamma) with Tukey weights about a plane.

    Args:
        plane: (3,) that residuals are taken of.
        width: residual from which on there is no weight, px.
        normal, right: (3, 3) upper triangle and (3,), overwritten.

    Returns:
        How many events have a weight.
    """
    # Without a branch and without a sum, several events are weighed at a time.
    weights = np.empty(len(u))
    for k in range(len(u)):
        share = (s[k] - plane[0] - plane[1] * u[k] - plane[2] * tau[k]) / width
        rest = max(1.0 - share * share, 0.0)
        weights[k] = rest * rest
    # Most have none: only the others are added up.
    inside = np.empty(len(u), np.int64)
    inliers = 0
    for k in range(len(u)):
        inside[inliers] = k
        inliers += weights[k] > 0.0
    w, wu, wt, wuu, wut, wtt, ws, wsu, wst = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(inliers):
        k = inside[i]
        weight = weights[k]
        along, later, aside = weight * u[k], weight * tau[k], weight * s[k]
        w += weight
        wu += along
        wt += later
        wuu += along * u[k]
        wut += along * tau[k]
        wtt += later * tau[k]
        ws += aside
        wsu += aside * u[k]
        wst += aside * tau[k]
    normal[0, 0], normal[0, 1], normal[0, 2] = w, wu, wt
    normal[1, 1], normal[1, 2], normal[2, 2] = wuu, wut, wtt
    right[0], right[1], right[2] = ws, wsu, wst
    return inliers


@numba.njit(cache=True, nogil=True)
def solve_3x3(upper: Array, right: Array, solution: Array) -> bool:
    """Solve a symmetric positive system given by its upper triangle (Cholesky); False if singular."""
    l00 = upper[0, 0]
    if l00 <= 0.0:
        return False
    l00 = np.sqrt(l00)
    l10, l20 = upper[0, 1] / l00, upper[0, 2] / l00
    l11 = upper[1, 1] - l10 * l10
    if l11 <= 1e-12 * upper[1, 1]:
        return False
    l11 = np.sqrt(l11)
    l21 = (upper[1, 2] - l20 * l10) / l11
    l22 = upper[2, 2] - l20 * l20 - l21 * l21
    if l22 <= 1e-12 * upper[2, 2]:
        return False
    l22 = np.sqrt(l22)
    y0 = right[0] / l00
    y1 = (right[1] - l10 * y0) / l11
    y2 = (right[2] - l20 * y0 - l21 * y1) / l22
    solution[2] = y2 / l22
    solution[1] = (y1 - l21 * solution[2]) / l11
    solution[0] = (y0 - l10 * solution[1] - l20 * solution[2]) / l00
    return True


@numba.njit(cache=True, nogil=True)
def walk_support(
    half: float, u: Array, residual: Array, settings: VoteSettings
) -> tuple[float, float, float]:
    """Ends of the longest supported run along u, and the share of its bins that hold events.

    A bin is full with at least a quarter of the mean over the seed; a run bridges at most
    `max_gap_bin_count` bins that are not.
    """
    size = settings.support_bin_px
    reach = half + settings.extension_px
    bin_count = int(np.ceil(2.0 * reach / size))
    counts = np.zeros(bin_count, np.int64)
    on_seed = 0
    for k in range(len(u)):
        if abs(residual[k]) < NEAR_PX:
            place = int((u[k] + reach) / size)
            if 0 <= place < bin_count:
                counts[place] += 1
                if abs(u[k]) <= half:
                    on_seed += 1
    full = max(1.0, 0.25 * on_seed * size / (2.0 * half))
    best_first, best_last, best_full = 0, -1, 0
    first, last, full_count = -1, -1, 0
    for place in range(bin_count):
        if counts[place] < full:
            continue
        if first < 0 or place - last - 1 > settings.max_gap_bin_count:
            first, full_count = place, 0
        last = place
        full_count += 1
        if last - first > best_last - best_first or best_last < 0:
            best_first, best_last, best_full = first, last, full_count
    if best_last < 0:
        return 0.0, 0.0, 0.0
    occupancy = best_full / (best_last - best_first + 1)
    # A lone bin beyond a gap is where another line crosses, not where this one ends.
    if best_first < best_last and counts[best_last - 1] < full:
        best_last -= 1
        while counts[best_last] < full:
            best_last -= 1
    if best_first < best_last and counts[best_first + 1] < full:
        best_first += 1
        while counts[best_first] < full:
            best_first += 1
    return best_first * size - reach, (best_last + 1) * size - reach, occupancy


@numba.njit(cache=True, nogil=True)
def fit_seed(
    segment: Array,
    side: int,
    grid: Grid,
    settings: VoteSettings,
    near: Array,
    line: Array,
) -> tuple[Array, float, float]:
    """Fit the space-time plane of one seed and one polarity.

    Args:
        line: (2, 2) written: the ends of the supported run on the plane's slice at the frame.

    Returns:
        The grown buffer, the normal speed (px/ms) and the score; the score is 0 where there is
        no line.
    """
    local = local_frame(segment)
    seed_half = local.half
    reach = seed_half + settings.extension_px
    near, count = gather(local, settings.candidate_distance_px, reach, side, grid, near)
    u, s, tau = local_coordinates(local, near[:count], grid)
    if count < 0.6 * seed_half:
        return near, 0.0, 0.0
    plane = np.zeros(3)
    plane[0], plane[2] = vote_speed(seed_half, u, s, tau, settings)
    for attempt in range(2):
        first_px = FIRST_PASS_PX if attempt == 0 else SECOND_PASS_PX
        inliers = fit_robust(u, s, tau, plane, first_px, settings.inlier_distance_px)
        moved = abs(plane[0]) > settings.candidate_distance_px or abs(plane[1]) > MAX_TURN
        fast = abs(plane[2]) > 2.0 * settings.max_speed_px_per_ms
        if inliers < 0.6 * seed_half or moved or fast:
            return near, 0.0, 0.0
        if attempt == 0:
            # Look again from the line just found: it may lie askew in the first candidates.
            turn = np.sqrt(1.0 + plane[1] * plane[1])
            dx = (local.dx - plane[1] * local.dy) / turn
            dy = (local.dy + plane[1] * local.dx) / turn
            qx, qy = local.qx - plane[0] * local.dy, local.qy + plane[0] * local.dx
            local = Local(qx, qy, dx, dy, seed_half)
            wide = SECOND_GATHER * settings.candidate_distance_px
            near, count = gather(local, wide, reach, side, grid, near)
            u, s, tau = local_coordinates(local, near[:count], grid)
            plane[0], plane[1], plane[2] = 0.0, 0.0, plane[2] / turn
    residual = s - plane[0] - plane[1] * u - plane[2] * tau
    start, stop, occupancy = walk_support(seed_half, u, residual, settings)
    length = stop - start
    near_count, far_count = 0, 0
    for k in range(count):
        if start <= u[k] <= stop:
            distance = abs(residual[k])
            near_count += distance < NEAR_PX
            far_count += NEAR_PX <= distance < FAR_PX
    beside = far_count / (2.0 * (FAR_PX - NEAR_PX)) + EMPTY_DENSITY_PER_PX * length
    if length <= 0.0 or occupancy < settings.min_occupancy:
        return near, 0.0, 0.0
    ratio = near_count / (2.0 * NEAR_PX) / beside
    if near_count < MIN_EVENTS_PER_PX * length or ratio < settings.min_density_ratio:
        return near, 0.0, 0.0
    for end in range(2):
        along = start if end == 0 else stop
        across = plane[0] + plane[1] * along
        line[end, 0] = local.qx + along * local.dx - across * local.dy
        line[end, 1] = local.qy + along * local.dy + across * local.dx
    return near, plane[2] / np.sqrt(1.0 + plane[1] * plane[1]), near_count * min(ratio, 4.0)


@numba.njit(cache=True, nogil=True)
def fit_by_vote(
    segments: Array,
    polarity: Array,
    grid: Grid,
    settings: VoteSettings,
) -> tuple[Array, Array, Array, Array]:
    """Fit every seed, those of unknown polarity once for each.

    Args:
        segments: (S, 2, 2) px.
        polarity: (S,) -1, 0 or +1.

    Returns:
        Lines (2S, 2, 2), speeds (2S,), scores (2S,) and polarities (2S,); rows 2i and 2i+1 belong
        to seed i. A score of 0 says that there is no line.
    """
    lines = np.zeros((2 * len(segments), 2, 2))
    speeds = np.zeros(2 * len(segments))
    scores = np.zeros(2 * len(segments))
    labels = np.zeros(2 * len(segments), np.int8)
    near = np.empty(4096, np.int64)
    for i in range(len(segments)):
        for side in range(2):
            label = 2 * side - 1
            if polarity[i] == -label:
                continue
            row = 2 * i + side
            labels[row] = label
            near, speeds[row], scores[row] = fit_seed(
                segments[i], side, grid, settings, near, lines[row]
            )
    return lines, speeds, scores, labels


@numba.njit(cache=True, nogil=True)
def support(
    lines: Array,
    speeds: Array,
    polarity: Array,
    grid: Grid,
    max_distance_px: float,
    max_tau_ms: float,
    max_count: int,
) -> tuple[Array, Array]:
    """The events that support each line, nearest in time first.

    Args:
        lines: (M, 2, 2) px, slices of the planes at the frame.
        speeds: (M,) px/ms along the left-hand normal.
        polarity: (M,) -1 or +1, or 0 for events of both.
        max_distance_px: distance of an event from the line moved to the event's time.
        max_tau_ms: largest time from the frame.
        max_count: most events a line.

    Returns:
        offsets (M + 1,) and event indices (offsets[-1],).
    """
    offsets = np.zeros(len(lines) + 1, np.int64)
    chosen = np.empty(1024, np.int64)
    near = np.empty(4096, np.int64)
    total = 0
    for m in range(len(lines)):
        local = local_frame(lines[m])
        reach = max_distance_px + abs(speeds[m]) * max_tau_ms
        found = np.empty(0, np.int64)
        for side in range(2):
            if polarity[m] == 1 - 2 * side:
                continue
            near, count = gather(local, reach, local.half, side, grid, near)
            _, s, tau = local_coordinates(local, near[:count], grid)
            fits = (np.abs(s - speeds[m] * tau) < max_distance_px) & (np.abs(tau) < max_tau_ms)
            found = np.concatenate((found, near[:count][fits]))
        # Equal times are told apart by the event's index: the order of the grid must not matter.
        # One number for both, in whole microseconds, is sorted several times faster than two.
        from_frame_us = np.rint(np.abs(grid.tau_ms[found]) * 1e3).astype(np.int64)
        key = np.sort(from_frame_us * MAX_EVENT_COUNT + grid.order[found])[:max_count]
        while total + len(key) > len(chosen):
            chosen = np.concatenate((chosen, np.empty_like(chosen)))
        chosen[total : total + len(key)] = key % MAX_EVENT_COUNT
        total += len(key)
        offsets[m + 1] = total
    return offsets, chosen[:total]


@numba.njit(cache=True, nogil=True)
def fit_by_ransac(
    segments: Array,
    grid: Grid,
    draws: Array,
    candidate_distance_px: float,
    scale_px_per_ms: float,
    inlier_distance_px: float,
    min_inlier_count: int,
) -> tuple[Array, Array, Array]:
    """The paper's fit: random planes in (x, y, scaled t), then least squares over the inliers.

    Args:
        segments: (S, 2, 2) px.
        draws: (S, T, 3) uniform in [0, 1): which three candidates make each trial's plane.
        scale_px_per_ms: length of a millisecond on the time axis.

    Returns:
        Lines (S, 2, 2), speeds (S,) px/ms and inlier counts (S,); a count of 0 says that there is
        no line.
    """
    lines = segments.copy()
    speeds = np.zeros(len(segments))
    scores = np.zeros(len(segments))
    near = np.empty(4096, np.int64)
    for i in range(len(segments)):
        local = local_frame(segments[i])
        reach = local.half + candidate_distance_px
        points = np.empty((0, 3))
        for side in range(2):
            near, count = gather(local, candidate_distance_px, reach, side, grid, near)
            u, s, tau = local_coordinates(local, near[:count], grid)
            part = np.column_stack((u, s, scale_px_per_ms * tau))
            close = segment_distance(u, s, local.half) < candidate_distance_px
            points = np.concatenate((points, part[close]))
        plane, inliers = fit_plane(points, draws[i], inlier_distance_px, min_inlier_count)
        a, b, c, offset = plane
        # A plane across the seed is of another line.
        if not abs(b) >= MIN_FACING:
            continue
        if b < 0.0:
            # The normal points to the left of the seed, so that speeds count along that side.
            a, b, c, offset = -a, -b, -c, -offset
        # Slice at tau = 0: a u + b s = offset; the seed's ends are projected onto it.
        for end in range(2):
            along = local.half if end else -local.half
            gap = offset - a * along
            u_end, s_end = along + gap * a, gap * b
            lines[i, end, 0] = local.qx + u_end * local.dx - s_end * local.dy
            lines[i, end, 1] = local.qy + u_end * local.dy + s_end * local.dx
        speeds[i] = -c * scale_px_per_ms
        scores[i] = inliers.sum()
    return lines, speeds, scores


@numba.njit(cache=True, nogil=True)
def segment_distance(u: Array, s: Array, half: float) -> Array:
    """(n,) distance of points from the segment |u| <= half, s = 0."""
    beyond = np.maximum(np.abs(u) - half, 0.0)
    return np.asarray(np.sqrt(beyond * beyond + s * s))


@numba.njit(cache=True, nogil=True)
def fit_plane(
    points: Array, draws: Array, inlier_distance: float, min_inlier_count: int
) -> tuple[tuple[float, float, float, float], Array]:
    """Total least squares plane over the inliers of the best random one.

    Args:
        points: (n, 3) two coordinates of the image and scaled time, px.
        draws: (T, 3) as in `fit_by_ransac`.

    Returns:
        (a, b, c, offset) of the plane a x + b y + c t = offset with a^2 + b^2 = 1, NaN where there
        is none or it is an instant rather than a moving line; and the (n,) inliers.
    """
    nothing = (np.nan, np.nan, np.nan, np.nan)
    inliers = np.zeros(len(points), np.bool_)
    if len(points) < 3:
        return nothing, inliers
    inliers = best_plane(points, draws, inlier_distance)
    if inliers.sum() < max(3, min_inlier_count):
        return nothing, inliers
    supporting = points[inliers]
    centre = np.array([supporting[:, axis].mean() for axis in range(3)])
    spread = supporting - centre
    # The smallest eigenvector of the scatter is the normal of the total least squares plane.
    a, b, c = np.linalg.eigh(spread.T @ spread)[1][:, 0]
    in_image = np.sqrt(a * a + b * b)
    if in_image < MIN_IMAGE_PART:
        return nothing, inliers
    a, b, c = a / in_image, b / in_image, c / in_image
    return (a, b, c, a * centre[0] + b * centre[1] + c * centre[2]), inliers


@numba.njit(cache=True, nogil=True)
def best_plane(points: Array, draws: Array, inlier_distance: float) -> Array:
    """(n,) bool: inliers of the random plane that has the most of them."""
    best_count = 0
    best = np.zeros(4)
    for trial in range(len(draws)):
        p = points[int(draws[trial, 0] * len(points))]
        q = points[int(draws[trial, 1] * len(points))]
        r = points[int(draws[trial, 2] * len(points))]
        a = (q[1] - p[1]) * (r[2] - p[2]) - (q[2] - p[2]) * (r[1] - p[1])
        b = (q[2] - p[2]) * (r[0] - p[0]) - (q[0] - p[0]) * (r[2] - p[2])
        c = (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])
        length = np.sqrt(a * a + b * b + c * c)
        if length < 1e-9:
            continue
        a, b, c = a / length, b / length, c / length
        offset = a * p[0] + b * p[1] + c * p[2]
        count = 0
        for k in range(len(points)):
            distance = a * points[k, 0] + b * points[k, 1] + c * points[k, 2] - offset
            count += abs(distance) < inlier_distance
        if count > best_count:
            best_count = count
            best[0], best[1], best[2], best[3] = a, b, c, offset
    distances = points @ best[:3] - best[3]
    return np.asarray((np.abs(distances) < inlier_distance) & (best_count > 0))
