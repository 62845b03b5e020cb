"""Which side of an edge is bright: the two flanks of a thin stripe are not one line.

An edge that brightens the pixels it passes has its bright side behind it. Polarity and speed in the
picture therefore tell the side, whichever way the camera moves, and a line that is printed or built
keeps it in all views.
"""

from __future__ import annotations

import numpy as np

from roel_service.arrays import FloatArray, IntArray
from roel_service.geometry import plucker, projection, segments
from roel_service.geometry.vectors import dot
from roel_service.mapping.frames import Frames, turn_rates
from roel_service.mapping.views import Views
from roel_service.scene.lines import InfiniteLines, LineObservations, LineTracks
from roel_service.scene.trajectory import Trajectory

# Slower edges may have turned round within their window: nothing is said of them.
MIN_SPEED_PX_PER_MS = 0.04


def bright_sides(
    observations: LineObservations,
    frames: Frames,
    trajectory: Trajectory,
    *,
    rotation_is_undone: bool,
) -> IntArray:
    """(M,) 1 where the left-hand side of a segment is bright, -1 where it is dark, 0 unknown.

    Args:
        observations: M lines; left is the side of their normal (-dy, dx).
        frames, trajectory: poses; the trajectory gives the camera's turn.
        rotation_is_undone: whether the speeds of the observations lack what the turn adds.
    """
    speed = observations.normal_speed_px_per_ms
    if rotation_is_undone:
        speed = speed + _turning_speeds(observations, frames, trajectory)
    # An edge that moves to its left and brightens is bright on its right.
    side = -observations.polarity * np.sign(speed)
    return np.where(np.abs(speed) > MIN_SPEED_PX_PER_MS, side, 0.0).astype(np.int64)


def _turning_speeds(
    observations: LineObservations, frames: Frames, trajectory: Trajectory
) -> FloatArray:
    """(M,) px/ms along the left-hand normal, at the middles, that the camera's turn alone makes."""
    segments_px = observations.segments_px
    xy = projection.normalized_from_pixel(segments_px.mean(axis=1), frames.K)
    ray = np.concatenate([xy, np.ones((len(xy), 1))], axis=-1)
    turn_per_ms = 1e-3 * turn_rates(frames, trajectory)[observations.frame]
    moved = np.cross(ray, turn_per_ms)
    flow = (moved[:, :2] - xy * moved[:, 2:]) * np.diagonal(frames.K)[:2]
    return dot(flow, segments.left_normal(segments_px))


def with_one_side(
    tracks: LineTracks, lines: InfiniteLines, views: Views, bright_side: IntArray, own: IntArray
) -> LineTracks:
    """Tracks without the observations that see a line's bright side where the line is dark.

    Args:
        tracks: of L lines.
        lines: L lines, world.
        views: of all observations.
        bright_side: (M,) of them, see `bright_sides`.
        own: (L,) see `sides_of_lines`.
    """
    line = tracks.track_of_row
    agrees = _sides(tracks, lines, views, bright_side) * own[line] >= 0
    return LineTracks.from_rows(line[agrees], tracks.observation[agrees], len(tracks))


def sides_of_lines(
    tracks: LineTracks, lines: InfiniteLines, views: Views, bright_side: IntArray
) -> IntArray:
    """(L,) the bright side of each line, left being 1, that most of its observations see."""
    sides = _sides(tracks, lines, views, bright_side)
    votes = np.bincount(tracks.track_of_row, sides, minlength=len(tracks))
    return np.sign(votes).astype(np.int64)


def _sides(
    tracks: LineTracks, lines: InfiniteLines, views: Views, bright_side: IntArray
) -> FloatArray:
    """(S,) bright side of each observation, as seen along its line's direction."""
    line, observation = tracks.track_of_row, tracks.observation
    moment = plucker.shift_origin(
        lines.direction[line], lines.moment[line], views.centre[observation]
    )
    same_way = np.sign(dot(views.normal[observation], moment))
    return np.asarray(bright_side[observation] * same_way)
