"""Tracks joined by correspondences between sampled frames.

Paper: "Local and Global Line Matching", the global part: frames are sampled, each is matched
against its nearest ones by camera centre, correspondences are confirmed by the epipolar geometry,
and tracks that correspond are joined. A `LineMatcher` finds the correspondences.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from scipy.spatial import cKDTree

from roel_service.arrays import FloatArray, IntArray
from roel_service.config.stages import Config, MatchGlobalConfig, TriangulateConfig
from roel_service.geometry import plucker, projection, segments
from roel_service.mapping.frames import Frames
from roel_service.mapping.match_global import project_segments
from roel_service.mapping.triangulate import triangulate_tracks
from roel_service.mapping.trim import covered_spans
from roel_service.mapping.views import Views
from roel_service.progress import StepCallback
from roel_service.scene.lines import LineTracks

# Provisional lines pass easily: a wrong one finds no correspondences.
PROVISIONAL = TriangulateConfig(gate="pixel", min_observation_count=2, min_inlier_count=2)


class LineMatcher(Protocol):
    """Finds the same lines in two frames."""

    def match(self, frame_i: int, frame_j: int) -> IntArray:
        """(n, 2) observations of frame i and of frame j that show the same line."""
        ...


class GeometricMatcher:
    """Correspondences from provisional 3D lines, one for each track that can be triangulated.

    Takes the place of the paper's learned matcher: the poses are known, so a line of frame i is
    looked for where its track's 3D line projects in frame j.
    """

    def __init__(self, tracks: LineTracks, views: Views, frames: Frames, config: Config) -> None:
        rng = np.random.default_rng(config.runtime.seed)
        found = triangulate_tracks(tracks, views, frames, PROVISIONAL, rng)
        spans_m = covered_spans(found.lines, found.tracks, views)
        self._segments_world = plucker.endpoints_from_plucker(
            found.lines.direction, found.lines.moment, spans_m
        )
        self._line_of = np.full(len(views), -1)
        self._line_of[found.tracks.observation] = found.tracks.track_of_row
        self._first = np.searchsorted(views.frame, np.arange(len(frames) + 1))
        self._views = views
        self._frames = frames
        self._max_distance_px = config.match_global.max_distances_px[0]

    def match(self, frame_i: int, frame_j: int) -> IntArray:
        """See `LineMatcher`; pairs are mutually nearest."""
        in_i = self._with_line(frame_i)
        in_j = np.arange(self._first[frame_j], self._first[frame_j + 1])
        projected = self._projected(in_i, frame_j)
        in_i, projected = (
            in_i[np.isfinite(projected[:, 0, 0])],
            projected[np.isfinite(projected[:, 0, 0])],
        )
        if len(in_i) == 0 or len(in_j) == 0:
            return np.empty((0, 2), np.int64)
        observed = self._views.segment_px[in_j]
        distance = segments.perpendicular_one_way(observed[None], projected[:, None])
        facing = segments.overlap(projected[:, None], observed[None])
        cost = np.where(facing > 0, distance, np.inf)
        nearest_j, nearest_i = cost.argmin(axis=1), cost.argmin(axis=0)
        rows = np.arange(len(in_i))
        mutual = (nearest_i[nearest_j] == rows) & (cost[rows, nearest_j] < self._max_distance_px)
        return np.stack([in_i[mutual], in_j[nearest_j[mutual]]], axis=1)

    def _with_line(self, frame: int) -> IntArray:
        members = np.arange(self._first[frame], self._first[frame + 1])
        return members[self._line_of[members] >= 0]

    def _projected(self, observations: IntArray, frame: int) -> FloatArray:
        T_camera_world = self._frames.T_world_camera[frame].inverse()
        return project_segments(
            self._segments_world[self._line_of[observations]], T_camera_world, self._frames
        )


def match_sampled_frames(
    tracks: LineTracks,
    views: Views,
    frames: Frames,
    config: Config,
    matcher: LineMatcher,
    progress: StepCallback,
) -> LineTracks:
    """Join the tracks whose lines correspond in sampled frames.

    Two tracks that both have an observation in some frame are different lines and stay apart.

    Args:
        tracks: from neighbouring frames.
        views: of all observations.
        frames: poses and calibration.
        config: `match_global`: sampling, neighbours, epipolar score.
        matcher: finds correspondences between two frames.
        progress: called for each pair of frames; may raise `Cancelled`.
    """
    settings = config.match_global
    pairs = sampled_pairs(frames, settings)
    matches = [np.empty((0, 2), np.int64)]
    for index, (frame_i, frame_j) in enumerate(pairs):
        progress(index, len(pairs))
        found = matcher.match(frame_i, frame_j)
        score = _epipolar_score(found, frame_i, frame_j, views, frames)
        matches.append(found[score >= settings.min_epipolar_score])
    return join_tracks(tracks, views, np.concatenate(matches))


def sampled_pairs(frames: Frames, config: MatchGlobalConfig) -> list[tuple[int, int]]:
    """Pairs i < j of every `frame_stride`-th frame and its nearest ones by camera centre."""
    sampled = np.arange(0, len(frames), config.frame_stride)
    if len(sampled) < 2:
        return []
    centres = frames.T_world_camera.translation[sampled]
    count = min(config.neighbor_count + 1, len(sampled))
    nearest = cKDTree(centres).query(centres, k=count)[1]
    both = np.stack([np.repeat(np.arange(len(sampled)), count), nearest.ravel()], axis=1)
    both = np.unique(np.sort(both[both[:, 0] != both[:, 1]], axis=1), axis=0)
    return [(int(i), int(j)) for i, j in sampled[both]]


def _epipolar_score(
    matches: IntArray, frame_i: int, frame_j: int, views: Views, frames: Frames
) -> FloatArray:
    """(n,) epipolar intersection over union of corresponding lines."""
    T_j_i = frames.T_world_camera[frame_j].inverse() @ frames.T_world_camera[frame_i]
    fundamental = projection.fundamental_matrix(frames.K, frames.K, T_j_i)
    lines_i, lines_j = views.segment_px[matches[:, 0]], views.segment_px[matches[:, 1]]
    return np.nan_to_num(segments.epipolar_iou(lines_i, lines_j, fundamental))


def join_tracks(tracks: LineTracks, views: Views, matches: IntArray) -> LineTracks:
    """Union of the tracks that (n, 2) corresponding observations connect, most often named first."""
    track_of = np.full(len(views), -1)
    track_of[tracks.observation] = tracks.track_of_row
    linked = np.sort(track_of[matches], axis=1)
    linked = linked[(linked[:, 0] >= 0) & (linked[:, 0] != linked[:, 1])]
    named, count = np.unique(linked, axis=0, return_counts=True)
    root = np.arange(len(tracks))
    seen_in = [set(views.frame[tracks[track]].tolist()) for track in range(len(tracks))]
    for first, second in named[np.argsort(-count, kind="stable")]:
        a, b = _root(root, first), _root(root, second)
        if a != b and seen_in[a].isdisjoint(seen_in[b]):
            root[b] = a
            seen_in[a] |= seen_in[b]
    roots = np.array([_root(root, track) for track in range(len(tracks))], dtype=np.int64)
    joined = np.unique(roots, return_inverse=True)[1]
    return LineTracks.from_rows(
        joined[tracks.track_of_row], tracks.observation, int(joined.max(initial=-1)) + 1
    )


def _root(root: IntArray, track: int) -> int:
    while root[track] != track:
        track = int(root[track])
    return int(track)
