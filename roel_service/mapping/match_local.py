"""Tracks of lines through neighbouring frames.

Paper: "Local and Global Line Matching", the local part: mutual nearest neighbours by perpendicular
distance. With `predict`, a line is first moved by its own speed and by the camera's rotation.
"""

from __future__ import annotations

import numpy as np

from roel_service.arrays import Array, FloatArray, IntArray
from roel_service.config.stages import MatchLocalConfig
from roel_service.geometry import segments
from roel_service.mapping import match_local_kernels
from roel_service.mapping.frames import Frames
from roel_service.scene.lines import LineObservations, LineTracks


def match_adjacent_frames(
    observations: LineObservations,
    frames: Frames,
    config: MatchLocalConfig,
    *,
    rotation_is_undone: bool = True,
) -> LineTracks:
    """Link lines of neighbouring frames into tracks, at most one line of a frame in each.

    `rotation_is_undone` says that the observed speeds are those of a camera that does not turn. A track stays open for `reach_frame_count` frames; every line starts or continues one.
    """
    first = np.searchsorted(observations.frame, np.arange(len(frames) + 1))
    track = np.full(len(observations), -1)
    track_count = 0
    open_ends = np.empty(0, np.int64)
    for frame in range(len(frames)):
        current = np.arange(first[frame], first[frame + 1])
        reach = observations.frame[open_ends] >= frame - config.reach_frame_count
        open_ends = open_ends[reach]
        before, after = _mutual_nearest(
            open_ends, current, observations, frames, config, rotation_is_undone
        )
        track[after] = track[before]
        new = current[track[current] < 0]
        track[new] = track_count + np.arange(len(new))
        track_count += len(new)
        continued = np.isin(open_ends, before)
        open_ends = np.concatenate([open_ends[~continued], current])
    return LineTracks.from_rows(track, np.arange(len(track)), track_count)


def _mutual_nearest(
    before: IntArray,
    after: IntArray,
    observations: LineObservations,
    frames: Frames,
    config: MatchLocalConfig,
    rotation_is_undone: bool,
) -> tuple[IntArray, IntArray]:
    """Pairs of observations that are each other's nearest and pass the gates."""
    if len(before) == 0 or len(after) == 0:
        return before[:0], after[:0]
    lines_before, lines_after = observations.segments_px[before], observations.segments_px[after]
    frames_before, group = np.unique(observations.frame[before], return_inverse=True)
    moved, returned = lines_before, np.repeat(lines_after[None], len(frames_before), axis=0)
    if config.predict:
        there = observations.frame[after[:1]]
        moved = predict(before, there, observations, frames, rotation_is_undone=rotation_is_undone)
        returned = np.stack(
            [
                predict(after, back, observations, frames, rotation_is_undone=rotation_is_undone)
                for back in frames_before[:, None]
            ]
        )
    of_before, of_after = match_local_kernels.nearest(
        moved,
        returned,
        group,
        lines_before,
        lines_after,
        observations.polarity[before],
        observations.polarity[after],
        not config.predict,
        config.max_distance_px,
        config.min_overlap,
    )
    mutual = (of_before >= 0) & (of_after[of_before] == np.arange(len(before)))
    return before[mutual], after[of_before[mutual]]


def predict(
    indices: IntArray,
    to_frame: Array,
    observations: LineObservations,
    frames: Frames,
    *,
    rotation_is_undone: bool = True,
) -> FloatArray:
    """(n, 2, 2) where observed lines lie in another frame: moved by their speed, then turned.

    Where its speed has the camera's rotation undone, a line is moved in the pixels of its own frame
    and the rotation is added; else the speed holds the rotation already.
    """
    lines_px = observations.segments_px[indices]
    own_frame = observations.frame[indices]
    left = segments.left_normal(lines_px)
    step_ms = (frames.t_us[to_frame] - frames.t_us[own_frame]) * 1e-3
    shift = (observations.normal_speed_px_per_ms[indices] * step_ms)[:, None] * left
    moved = lines_px + shift[:, None]
    if not rotation_is_undone:
        return np.asarray(moved)
    R = frames.T_world_camera.rotation
    R_to_own = np.swapaxes(R[to_frame], -1, -2) @ R[own_frame]
    H = frames.K @ R_to_own @ np.linalg.inv(frames.K)
    homogeneous = moved @ np.swapaxes(H[:, :, :2], -1, -2) + H[:, None, :, 2]
    return np.asarray(homogeneous[..., :2] / homogeneous[..., 2:])
