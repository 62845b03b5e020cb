"""3D lines from tracks: RANSAC over pairs of views.

Paper: "Line Triangulation". Every hypothesis is the line in which two viewing planes meet; the one
that most of the track agrees with wins. All tracks are tried together, in batches of equal length.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from roel_service.arrays import BoolArray, FloatArray, IntArray
from roel_service.config.stages import TriangulateConfig
from roel_service.geometry import grassmann, plucker, projection, segments
from roel_service.geometry.se3 import SE3
from roel_service.geometry.vectors import dot
from roel_service.in_order import in_order
from roel_service.mapping.frames import Frames
from roel_service.mapping.views import Views, cuts_m, end_residuals_px
from roel_service.scene.lines import InfiniteLines, LineTracks
from roel_service.scene.results import TrackStatus

# Hypotheses times observations handled at once; bounds memory to some hundred megabytes.
BATCH_SIZE = 200_000
# Parent of a track without a hypothesis.
NO_PAIR = -1


@dataclass(frozen=True, eq=False, kw_only=True)
class Triangulated:
    """Lines with the observations that support them.

    Attributes:
        lines: L lines, world.
        tracks: the inliers of each line.
        statuses: what became of every track that was given.
    """

    lines: InfiniteLines
    tracks: LineTracks
    statuses: list[TrackStatus]


@dataclass(frozen=True, eq=False, kw_only=True)
class _Hypotheses:
    """H lines for each of T tracks.

    Attributes:
        direction, moment: (T, H, 3), NaN where the two views are no pair.
        sine: (T, H) of the angle between the two viewing planes.
        parent: (T, H) which of the track's scored views is the first of the pair.
    """

    direction: FloatArray
    moment: FloatArray
    sine: FloatArray
    parent: IntArray


@dataclass(frozen=True, eq=False, kw_only=True)
class _BestPairs:
    """The best hypothesis of each track of a batch.

    Attributes:
        batch: (T,) indices of the tracks.
        direction, moment: (T, 3) lines.
        parent: (T,) observation that is the first of the pair, or `NO_PAIR`.
    """

    batch: IntArray
    direction: FloatArray
    moment: FloatArray
    parent: IntArray


def triangulate_tracks(
    tracks: LineTracks,
    views: Views,
    frames: Frames,
    config: TriangulateConfig,
    rng: np.random.Generator,
    *,
    worker_count: int = 1,
) -> Triangulated:
    """Triangulate every track that is long enough.

    Args:
        tracks: observations of the same line.
        views: of all observations.
        frames: calibration of the views.
        config: gates and numbers of trials.
        rng: draws the pairs.
        worker_count: threads; the answer is the same with any.
    """
    direction = np.full((len(tracks), 3), np.nan)
    moment = np.full((len(tracks), 3), np.nan)
    parent = np.full(len(tracks), NO_PAIR)

    def of_batch(drawn: tuple[IntArray, FloatArray]) -> _BestPairs:
        return _best_pairs(tracks, views, frames, config, *drawn)

    # Drawn here, one batch after the other, whichever thread needs them.
    draws = (
        (batch, rng.random((2, len(batch), config.pair_count)))
        for batch in _batches(tracks, config)
    )
    for found in in_order(of_batch, draws, worker_count):
        direction[found.batch] = found.direction
        moment[found.batch] = found.moment
        parent[found.batch] = found.parent
    inlier = np.zeros(len(tracks.observation), dtype=bool)
    rows = np.flatnonzero(parent[tracks.track_of_row] != NO_PAIR)
    track = tracks.track_of_row[rows]
    inlier[rows] = _inliers(
        views.take(tracks.observation[rows]),
        views.take(parent[track]),
        direction[track],
        moment[track],
        frames,
        config,
    )
    counts = np.bincount(tracks.track_of_row[inlier], minlength=len(tracks))
    good = (parent != NO_PAIR) & (counts >= config.min_inlier_count)
    status = np.full(len(tracks), TrackStatus.TRIANGULATED)
    status[~good] = TrackStatus.TOO_FEW_INLIERS
    status[parent == NO_PAIR] = TrackStatus.LOW_PARALLAX
    status[tracks.sizes < config.min_observation_count] = TrackStatus.TOO_FEW_VIEWS
    kept = inlier & good[tracks.track_of_row]
    return Triangulated(
        lines=InfiniteLines(direction=direction[good], moment=moment[good]),
        tracks=LineTracks(
            offsets=np.concatenate([[0], np.cumsum(counts[good])]),
            observation=tracks.observation[kept],
        ),
        statuses=status.tolist(),
    )


def _best_pairs(
    tracks: LineTracks,
    views: Views,
    frames: Frames,
    config: TriangulateConfig,
    batch: IntArray,
    draws: FloatArray,
) -> _BestPairs:
    """The pair of views, among (2, T, H) random ones, whose line each of T tracks agrees with most."""
    members, valid = _scored_members(tracks, batch, config.scored_observation_count)
    scored = views.take(members)
    hypotheses = _hypothesise(scored, valid, config, draws)
    best, tried = _best(hypotheses, scored, valid, frames, config)
    rows = np.arange(len(batch))
    return _BestPairs(
        batch=batch,
        direction=hypotheses.direction[rows, best],
        moment=hypotheses.moment[rows, best],
        parent=np.where(tried, members[rows, hypotheses.parent[rows, best]], NO_PAIR),
    )


def _batches(tracks: LineTracks, config: TriangulateConfig) -> Iterator[IntArray]:
    """Indices of the tracks that are long enough, in batches of similar length."""
    sizes = np.diff(tracks.offsets)
    order = np.argsort(sizes, kind="stable")
    order = order[sizes[order] >= config.min_observation_count]
    start = 0
    while start < len(order):
        # The batch's longest track sets its width: look ahead from the shortest one.
        stop = start + 1
        while stop < len(order):
            width = min(int(sizes[order[stop]]), config.scored_observation_count)
            if (stop + 1 - start) * width * config.pair_count > BATCH_SIZE:
                break
            stop += 1
        yield order[start:stop]
        start = stop


def _scored_members(
    tracks: LineTracks, batch: IntArray, max_count: int
) -> tuple[IntArray, BoolArray]:
    """(T, W) observations of each track, spread evenly over it, and (T, W) which of them count."""
    sizes = np.diff(tracks.offsets)[batch]
    counts = np.minimum(sizes, max_count)
    width = int(counts.max())
    step = np.arange(width)[None] * sizes[:, None] // np.maximum(counts, 1)[:, None]
    valid = np.arange(width)[None] < counts[:, None]
    place = tracks.offsets[batch][:, None] + np.where(valid, step, 0)
    return tracks.observation[place], valid


def _hypothesise(
    views: Views, valid: BoolArray, config: TriangulateConfig, draws: FloatArray
) -> _Hypotheses:
    """Lines of pairs of the (T, W) views, by (2, T, H) draws from [0, 1)."""
    counts = valid.sum(axis=1)[:, None]
    first = (draws[0] * counts).astype(np.intp)
    # The second view is any but the first.
    second = (first + 1 + (draws[1] * (counts - 1)).astype(np.intp)) % counts
    rows = np.arange(len(valid))[:, None]
    p, q = views.take((rows, first)), views.take((rows, second))
    direction, moment, sine = plucker.intersect_planes(p.normal, p.centre, q.normal, q.centre)
    in_front = _in_front(p, direction, moment) & _in_front(q, direction, moment)
    admissible = in_front & (sine >= np.sin(np.deg2rad(config.min_plane_angle_deg)))
    return _Hypotheses(
        direction=np.where(admissible[..., None], direction, np.nan),
        moment=np.where(admissible[..., None], moment, np.nan),
        sine=sine,
        parent=first,
    )


def _in_front(views: Views, direction: FloatArray, moment: FloatArray) -> BoolArray:
    """(*B,) whether both observed ends lie on the line in front of the camera."""
    return np.asarray((cuts_m(views, direction, moment)[1] > 0).all(axis=-1))


def _best(
    hypotheses: _Hypotheses,
    views: Views,
    valid: BoolArray,
    frames: Frames,
    config: TriangulateConfig,
) -> tuple[IntArray, BoolArray]:
    """(T,) hypothesis that the track agrees with most, and (T,) whether there was any."""
    rows = np.arange(len(valid))[:, None]
    parents = views.take((rows, hypotheses.parent))
    agreement = _agreement(
        views.take((slice(None), None)),
        parents.take((slice(None), slice(None), None)),
        hypotheses.direction[:, :, None],
        hypotheses.moment[:, :, None],
        frames,
        config,
    )
    exists = np.isfinite(hypotheses.direction[..., 0])
    score = np.where(valid[:, None], agreement, 0.0).sum(axis=-1)
    return np.where(exists, score, -1.0).argmax(axis=1), np.asarray(exists.any(axis=1))


def _agreement(
    views: Views,
    parent: Views,
    direction: FloatArray,
    moment: FloatArray,
    frames: Frames,
    config: TriangulateConfig,
) -> FloatArray:
    """(*B,) how well observations agree with lines; 0 for outliers.

    Args:
        views: (*B) observations.
        parent: (*B) the first view of the pair that made each line.
        direction, moment: (*B, 3) lines, world, m.
    """
    if config.gate == "pixel":
        return _pixel_agreement(views, direction, moment, frames, config)
    return _grassmann_agreement(views, parent, direction, moment, frames, config)


def _pixel_agreement(
    views: Views,
    direction: FloatArray,
    moment: FloatArray,
    frames: Frames,
    config: TriangulateConfig,
) -> FloatArray:
    """sqrt(length) (1 - (e / e_max)^2), e the larger end distance: long and close ones count."""
    residual = end_residuals_px(views, direction, moment, frames.focal_px)
    share = np.abs(residual).max(axis=-1) / config.max_residual_px
    return np.asarray(np.sqrt(views.length_px) * np.fmax(1.0 - share**2, 0.0))


def _grassmann_agreement(
    views: Views,
    parent: Views,
    direction: FloatArray,
    moment: FloatArray,
    frames: Frames,
    config: TriangulateConfig,
) -> FloatArray:
    """1 where the principal angle and all four segment distances pass their gates, else 0.

    3D angle and perspective distance compare the line with the one that the parent makes with
    this observation, both cut to the parent's two rays; the 2D distances compare its projection
    with the observation. The parent agrees with its own line.
    """
    segment = _cut_to_rays(parent, direction, moment)
    theta = grassmann.plane_line_angle(
        views.normal, views.centre, direction, segments.midpoint(segment)
    )
    direction_k, moment_k, _ = plucker.intersect_planes(
        parent.normal, parent.centre, views.normal, views.centre
    )
    segment_k = _cut_to_rays(parent, direction_k, moment_k)
    angle_3d = np.arccos(np.minimum(np.abs(dot(direction, direction_k)), 1.0))
    perspective = segments.perspective_distance(
        _in_camera(segment, parent, frames), _in_camera(segment_k, parent, frames)
    )
    projected_px = projection.project(_in_camera(segment, views, frames), frames.K)
    passes = theta < np.deg2rad(config.max_grassmann_angle_deg)
    passes &= angle_3d < np.deg2rad(config.max_angle_3d_deg)
    passes &= perspective < config.max_perspective
    passes &= segments.angle_rad(projected_px, views.segment_px) < np.deg2rad(
        config.max_angle_2d_deg
    )
    passes &= segments.perpendicular(projected_px, views.segment_px) < config.max_perpendicular_px
    return np.asarray(passes | (views.frame == parent.frame), dtype=np.float64)


def _cut_to_rays(views: Views, direction: FloatArray, moment: FloatArray) -> FloatArray:
    """(*B, 2, 3) points of lines nearest to the rays of the observed ends, m, world."""
    return plucker.nearest_to_ray(
        direction[..., None, :], moment[..., None, :], views.centre[..., None, :], views.end_rays
    )


def _in_camera(points: FloatArray, views: Views, frames: Frames) -> FloatArray:
    """(*B, 2, 3) world points in the camera frame of the views."""
    T_camera_world = frames.T_world_camera[views.frame].inverse()
    return (
        SE3(
            rotation=T_camera_world.rotation[..., None, :, :],
            translation=T_camera_world.translation[..., None, :],
        )
        @ points
    )


def _inliers(
    views: Views,
    parent: Views,
    direction: FloatArray,
    moment: FloatArray,
    frames: Frames,
    config: TriangulateConfig,
) -> BoolArray:
    """(n,) which observations agree with the best lines of their tracks, in front of the camera."""
    agreement = _agreement(views, parent, direction, moment, frames, config)
    return _in_front(views, direction, moment) & (agreement > 0)
