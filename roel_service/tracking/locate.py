"""Where the camera may be, from a rough guess: lines of one moment laid onto those of the map.

Poses all over the reach of the guess are scored by fields of nearness to the lines that are seen,
one field for each direction; the best ones breed closer ones while the fields get narrower. What is
left is fitted to the space-time planes of the lines, which tell the velocity too.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence

import cv2
import numpy as np

from roel_service.arrays import Array, FloatArray
from roel_service.config.stages import TrackConfig
from roel_service.geometry import segments
from roel_service.geometry.se3 import SE3
from roel_service.mapping.plane_fit import FittedLines
from roel_service.tracking import search_kernels
from roel_service.tracking.fit import MIN_DEPTH_SHARE, View, Window, WindowFit, fit_window
from roel_service.tracking.motion import MotionState
from roel_service.tracking.pieces import equal_parts
from roel_service.tracking.sight import Eyes, Sight

# Directions that are told apart, of half a turn.
DIRECTION_COUNT = 12
# Pixels of a cell of the fields, and how near is near in each round, both shares of the focal
# length.
CELL_SHARE = 0.008
NEARNESS_SHARES = (0.04, 0.02, 0.01, 0.006)
# The first round's poses are so far apart, as shares of the reach.
TURN_STEP, SHIFT_STEP = 0.3, 0.5
# Poses that are kept after a round, and children of each.
KEPT_COUNT, CHILD_COUNT = 40, 24
# Poses that are fitted in the end, at least this far apart as shares of the reach.
FITTED_COUNT, APART = 6, 0.15
# Poses this close are one.
SAME_DEG, SAME_M = 0.5, 0.01
# Points of a seen line are so far apart, in its direction and in time.
POINT_PX, MOMENTS_S = 2.0, (-0.005, 0.0, 0.005)
# So many points of seen lines are fitted, and so many of the map's lines that may be in view are scored.
SAMPLED_COUNT, SCORED_COUNT = 3_000, 200
# So many cells from any line, nothing is near.
FAR = 1e4
# Scales of the fits, px: to the lines that are seen, then to events.
LINE_SCALES_PX, EVENT_SCALES_PX = (6.0, 3.0, 1.5), (2.0, 1.0)
UNSURE_SCALES_PX = (4.0, *EVENT_SCALES_PX)
# What the fields of a round take, about, scores of so many poses, and fits to lines and to events.
FIELDS_MS = 6.0
STEP_POSE_COUNT, STEP_MS = 1_200, 6.0
LINE_FIT_MS, EVENT_FIT_MS = 4.5, 6.5
# What is not known of a pose after the search, as shares of the reach; and of the velocity.
POSE_SIGMA_SHARE = 0.5
SPEED_SIGMA_DEG_S, SPEED_SIGMA_M_S = 60.0, 1.0


def locating(
    guess: SE3,
    sight: Sight,
    window: Window,
    eyes: Eyes,
    config: TrackConfig,
    rng: np.random.Generator,
) -> Generator[float, None, list[WindowFit]]:
    """States in the middle of a window, within the configured reach of a guess, the best first.

    Args:
        guess: rough `T_world_camera`.
        sight: lines in the middle of the window, with their speeds, and the turn that they tell.
        window: the events of one interval.
        rng: draws the poses that are tried.

    Yields:
        Before each step of the work, about how many ms it takes.

    Returns:
        Fits that lie apart, however poor; none where no line is seen.
    """
    poses = yield from _searching(guess, sight.lines, eyes, config, rng)
    sampled = _sampled(sight.lines, window.t_us).thinned(SAMPLED_COUNT)
    starts = [
        roughly_at(pose, _turning(pose, sight.turn_rate), window.t_us, config) for pose in poses
    ]
    on_lines = yield from _fitting(starts, sampled, eyes, config, LINE_SCALES_PX, LINE_FIT_MS)
    best = [fit.state for fit in on_lines]
    return (yield from _fitting(best, window, eyes, config, UNSURE_SCALES_PX, EVENT_FIT_MS))


def _fitting(
    starts: Sequence[MotionState],
    window: Window,
    eyes: Eyes,
    config: TrackConfig,
    scales_px: tuple[float, ...],
    fit_ms: float,
) -> Generator[float, None, list[WindowFit]]:
    """What is left of the starts, the best first."""
    fits: list[WindowFit] = []
    for start in starts:
        yield fit_ms
        fits.append(fit_window(start, window, eyes.pieces, eyes.view, config, scales_px))
    return distinct(sorted(fits, key=explained_count, reverse=True))


def explained_count(fit: WindowFit) -> float:
    """Events that a fit explains."""
    return fit.evidence.explained_count


def distinct(fits: Sequence[WindowFit]) -> list[WindowFit]:
    """The first fits of which none is the same pose as an earlier one."""
    kept: list[WindowFit] = []
    for fit in fits:
        if not any(is_same_pose(fit.state, other.state) for other in kept):
            kept.append(fit)
    return kept


def is_same_pose(one: MotionState, other: MotionState) -> bool:
    """Whether two poses are nearer than what tells them apart."""
    step = one.T_world_camera.local(other.T_world_camera)
    turn_rad, shift_m = np.linalg.norm(step.reshape(2, 3), axis=1)
    return bool(turn_rad < np.deg2rad(SAME_DEG) and shift_m < SAME_M)


def roughly_at(pose: SE3, velocity: FloatArray, t_us: int, config: TrackConfig) -> MotionState:
    """A pose and a (6,) velocity of which little is known."""
    deviation = [
        *[POSE_SIGMA_SHARE * np.deg2rad(config.reach_deg)] * 3,
        *[POSE_SIGMA_SHARE * config.reach_m] * 3,
        *[np.deg2rad(SPEED_SIGMA_DEG_S)] * 3,
        *[SPEED_SIGMA_M_S] * 3,
    ]
    return MotionState(
        t_us=t_us,
        T_world_camera=pose,
        velocity=velocity,
        covariance=np.diag(np.square(deviation)),
    )


def _turning(pose: SE3, turn_rate: FloatArray) -> FloatArray:
    """(6,) velocity that moves the picture as a turn about (3,) camera axes does."""
    return np.concatenate([pose.rotation @ turn_rate, np.zeros(3)])


def _sampled(lines: FittedLines, t_us: int) -> Window:
    """Points of the space-time planes of lines, as a window of events would have them."""
    along = segments.span(lines.segments_px)
    length_px = segments.length(lines.segments_px)
    line, begin, end = equal_parts(np.maximum(2, np.ceil(length_px / POINT_PX)))
    middle = 0.5 * (begin + end)[:, None]
    xy_px = lines.segments_px[line, 0] + middle * along[line]
    normal = segments.left_normal(lines.segments_px)
    speed_px_per_s = 1e3 * lines.normal_speed_px_per_ms[:, None] * normal
    moments_s = np.array(MOMENTS_S)
    moved = xy_px + moments_s[:, None, None] * speed_px_per_s[line]
    return Window(
        t_us=t_us,
        xy_px=moved.reshape(-1, 2),
        slot=np.repeat(np.arange(len(moments_s)), len(line)),
        slot_s=moments_s,
        span_s=MOMENTS_S[-1] - MOMENTS_S[0],
        is_quiet=False,
        event_count=len(moved[0]),
    )


def _searching(
    guess: SE3, lines: FittedLines, eyes: Eyes, config: TrackConfig, rng: np.random.Generator
) -> Generator[float, None, list[SE3]]:
    """The most likely poses within reach of a guess, some apart from each other."""
    focal_px = float(np.sqrt(eyes.view.K[0, 0] * eyes.view.K[1, 1]))
    reach = np.array([np.deg2rad(config.reach_deg)] * 3 + [config.reach_m] * 3)
    cell_px = CELL_SHARE * focal_px
    points, direction = _scored(guess, eyes, config)
    if len(points) == 0 or len(lines.polarity) == 0:
        return []
    tangents = _grid() * reach
    spread = np.array([TURN_STEP] * 3 + [SHIFT_STEP] * 3) * reach
    for share in NEARNESS_SHARES:
        yield FIELDS_MS
        fields = _fields(lines.segments_px, share * focal_px, cell_px, eyes.view)
        means = fields.mean(axis=(1, 2), dtype=np.float64)
        variances = fields.var(axis=(1, 2), dtype=np.float64)
        scores = []
        for part in np.array_split(tangents, -(-len(tangents) // STEP_POSE_COUNT)):
            yield STEP_MS
            poses = guess.retract(part)
            score = search_kernels.scores(
                poses.rotation,
                poses.translation,
                points,
                direction,
                eyes.view.K,
                fields,
                means,
                variances,
                cell_px,
                MIN_DEPTH_SHARE * eyes.pieces.extent_m,
            )
            scores.append(score)
        best = np.argsort(-np.concatenate(scores), kind="stable")[:KEPT_COUNT]
        tangents = tangents[best]
        if share != NEARNESS_SHARES[-1]:
            spread = 0.5 * spread
            noise = rng.normal(size=(len(tangents), CHILD_COUNT, 6)) * spread
            children = _within_reach((tangents[:, None] + noise).reshape(-1, 6) / reach) * reach
            tangents = np.concatenate([tangents, children])
    return [guess.retract(tangent) for tangent in _apart(tangents / reach) * reach]


def _scored(guess: SE3, eyes: Eyes, config: TrackConfig) -> tuple[FloatArray, FloatArray]:
    """(S, 3) middles and directions of the map's pieces that a pose near a guess may see."""
    view, pieces = eyes.view, eyes.pieces
    corner = np.hypot(view.width / view.K[0, 0], view.height / view.K[1, 1]) / 2.0
    half_view = np.arctan(corner) + np.deg2rad(config.reach_deg)
    middles = pieces.segments.mean(axis=1)
    # From behind the guess, whatever a camera within reach sees lies within this cone.
    axis = guess.rotation[:, 2]
    apex = guess.translation - axis * config.reach_m / np.sin(min(half_view, np.pi / 2))
    away = middles - apex
    may_be_seen = away @ axis >= np.cos(half_view) * np.linalg.norm(away, axis=1)
    chosen = np.flatnonzero(may_be_seen)
    chosen = chosen[:: max(1, -(-len(chosen) // SCORED_COUNT))]
    return middles[chosen], pieces.direction[chosen]


def _within_reach(shares: FloatArray) -> FloatArray:
    """(n, 6) tangents, as shares of the reach, none of them beyond it."""
    parts = shares.reshape(-1, 2, 3)
    beyond = np.maximum(1.0, np.linalg.norm(parts, axis=2, keepdims=True))
    return np.asarray((parts / beyond).reshape(-1, 6))


def _grid() -> FloatArray:
    """(n, 6) tangents of the first round's poses, as shares of the reach."""
    turns, shifts = _ball(TURN_STEP), _ball(SHIFT_STEP)
    return np.concatenate(
        [np.repeat(turns, len(shifts), axis=0), np.tile(shifts, (len(turns), 1))], axis=1
    )


def _ball(step: float) -> FloatArray:
    """(n, 3) points of a cubic grid within the unit ball."""
    axis = np.arange(-np.floor(1.0 / step), np.floor(1.0 / step) + 1) * step
    grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    return np.asarray(grid[np.linalg.norm(grid, axis=1) <= 1.0])


def _apart(candidates: FloatArray) -> FloatArray:
    """(n, 6) the first candidates of which none lies beside an earlier one."""
    kept: list[FloatArray] = []
    for candidate in candidates:
        if all(np.abs(candidate - other).max() > APART for other in kept):
            kept.append(candidate)
        if len(kept) == FITTED_COUNT:
            break
    return np.array(kept)


def _fields(segments_px: FloatArray, nearness_px: float, cell_px: float, view: View) -> Array:
    """(A, h, w) float32: for each direction, how near a segment of about that direction is."""
    height, width = (int(np.ceil(size / cell_px)) for size in (view.height, view.width))
    along = segments.span(segments_px)
    angle = np.arctan2(along[:, 1], along[:, 0]) / np.pi * DIRECTION_COUNT
    place = np.round(angle).astype(np.int64)
    ends = np.round((segments_px + 0.5) / cell_px - 0.5).astype(np.int32)
    fields = np.empty((DIRECTION_COUNT, height, width), np.float32)
    for direction in range(DIRECTION_COUNT):
        apart = (place - direction + DIRECTION_COUNT // 2) % DIRECTION_COUNT - DIRECTION_COUNT // 2
        ink = np.full((height, width), 255, np.uint8)
        cv2.polylines(ink, list(ends[np.abs(apart) <= 1]), isClosed=False, color=0)
        # Without a line everything is far away, and OpenCV says how far: a number to overflow.
        away = np.minimum(cv2.distanceTransform(ink, cv2.DIST_L2, 3), FAR)
        fields[direction] = np.exp(-0.5 * np.square(away * (cell_px / nearness_px)))
    return fields
