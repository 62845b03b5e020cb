"""Lines collect their observations from all frames.

Paper: "Local and Global Line Matching", the global part, by geometry in place of a learned matcher:
triangulated lines are projected into every frame, take up what fits there, and are refined again,
in rounds of shrinking distance. The paper's own scheme is in `match_sampled`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import sparse

from roel_service.arrays import FloatArray, IntArray
from roel_service.config.stages import Config
from roel_service.geometry import plucker
from roel_service.geometry.se3 import SE3
from roel_service.geometry.vectors import norm
from roel_service.in_order import in_order
from roel_service.mapping import match_global_kernels
from roel_service.mapping.contrast import bright_sides, sides_of_lines, with_one_side
from roel_service.mapping.directions import direction_prior
from roel_service.mapping.evidence import Evidence
from roel_service.mapping.frames import Frames, velocities
from roel_service.mapping.front_end import worker_count
from roel_service.mapping.refine import Refined, refine_lines
from roel_service.mapping.trim import covered_spans
from roel_service.mapping.views import Views, end_residuals_px
from roel_service.progress import StepCallback
from roel_service.scene.lines import InfiniteLines, LineObservations, LineTracks
from roel_service.scene.trajectory import Trajectory

# A line is looked for this much beyond what is covered of it, at each end.
LENGTHENING = 0.1
# Lines are projected where they are at least this far in front of the camera, as a share of their
# own distance, and at least as far as divides.
NEAR_SHARE = 1e-3
LEAST_DEPTH_M = 1e-9
# Shorter projections are not looked at.
MIN_PROJECTION_PX = 5.0
# How much many observations count against a small residual when lines compete for one: px for a
# factor of e.
COMPETITION_PX = 0.3
# Decimals of that cost, px, that tell lines apart.
COST_DECIMALS = 6


def reassociate(
    refined: Refined,
    evidence: Evidence,
    observations: LineObservations,
    frames: Frames,
    trajectory: Trajectory,
    config: Config,
    progress: StepCallback,
) -> Refined:
    """Let lines collect their observations from all frames, in rounds.

    In a round lines may share observations while they grow; at its end each observation goes to the
    line that it fits best.

    Args:
        refined: first lines with their tracks.
        evidence, observations: of all frames.
        frames, trajectory: poses; the trajectory gives the camera's velocity.
        config: `match_global` and, for between the rounds, `refine_rounds`. Speeds can be predicted where
            `frames` undoes the camera's rotation.
        progress: called once a round; may raise `Cancelled`.
    """
    settings = config.match_global
    is_undone = config.frames.compensate_rotation
    velocity = velocities(frames, trajectory) if is_undone else None
    bright_side = (
        bright_sides(observations, frames, trajectory, rotation_is_undone=is_undone)
        if settings.one_side
        else None
    )
    round_count = len(settings.max_distances_px)
    for index, max_distance_px in enumerate(settings.max_distances_px):
        progress(index, round_count)
        found = _associate(
            refined, evidence.views, observations, frames, velocity, max_distance_px, config
        )
        if bright_side is not None:
            found = _one_sided(found, refined, evidence.views, bright_side)
        refined = _held(refined, found, evidence, frames, config)
        refined = _without_shared(refined, len(observations), settings.max_shared_fraction)
        exclusive = _exclusive(refined, evidence.views, frames)
        refined = _held(refined, exclusive, evidence, frames, config)
    return refined


def match_fixed_lines(
    lines: InfiniteLines,
    spans: FloatArray,
    evidence: Evidence,
    observations: LineObservations,
    frames: Frames,
    trajectory: Trajectory,
    config: Config,
) -> Refined:
    """The observations along lines that are known and stay as they are; lines without are left out.

    Args:
        lines: L lines, world.
        spans: (L, 2, 3) their segments, world.
        evidence, observations: of all frames.
        frames, trajectory: poses, off by no more than the first of
            `match_global.max_distances_px`.
        config: as of `reassociate`.
    """
    settings = config.match_global
    velocity = velocities(frames, trajectory) if config.frames.compensate_rotation else None
    distance_px = settings.max_distances_px[0]
    pairs = _along(lines, spans, observations, frames, velocity, distance_px, config)
    stay = replace(config.refine_rounds, iteration_count=0)
    tracks = LineTracks.from_rows(*pairs, len(lines))
    found = _usable(refine_lines(lines, tracks, evidence, frames, stay))
    exclusive = _exclusive(found, evidence.views, frames)
    return _usable(refine_lines(found.lines, exclusive, evidence, frames, stay))


def _held(
    refined: Refined,
    tracks: LineTracks,
    evidence: Evidence,
    frames: Frames,
    config: Config,
) -> Refined:
    """The lines refined over other tracks, held by the directions that they share so far."""
    cost, workers = config.refine_rounds, worker_count(config)
    prior = direction_prior(refined, cost, workers)
    return _usable(
        refine_lines(refined.lines, tracks, evidence, frames, cost, prior, worker_count=workers)
    )


def _usable(refined: Refined) -> Refined:
    """Without the lines that diverged."""
    return refined.take(~refined.diverged)


def _associate(
    refined: Refined,
    views: Views,
    observations: LineObservations,
    frames: Frames,
    velocity: FloatArray | None,
    max_distance_px: float,
    config: Config,
) -> LineTracks:
    """Each line's inliers so far, and every observation that lies along its projection."""
    spans = _lengthened(refined, views)
    line, member = _along(
        refined.lines, spans, observations, frames, velocity, max_distance_px, config
    )
    line = np.concatenate([refined.tracks.track_of_row, line])
    member = np.concatenate([refined.tracks.observation, member])
    # One number a pair: they are sorted ten times faster than columns.
    pairs = np.sort(line.astype(np.int64) * len(observations) + member)
    pairs = pairs[np.diff(pairs, prepend=-1) > 0]
    return LineTracks.from_rows(*np.divmod(pairs, max(1, len(observations))), len(refined))


def _one_sided(
    found: LineTracks, refined: Refined, views: Views, bright_side: IntArray
) -> LineTracks:
    """Without the observations whose bright side is not that of most that the line had before."""
    own = sides_of_lines(refined.tracks, refined.lines, views, bright_side)
    return with_one_side(found, refined.lines, views, bright_side, own)


def _along(
    lines: InfiniteLines,
    spans: FloatArray,
    observations: LineObservations,
    frames: Frames,
    velocity: FloatArray | None,
    max_distance_px: float,
    config: Config,
) -> tuple[IntArray, IntArray]:
    """Lines (n,) and observations (n,), pairwise, that lie along each other in a frame.

    Args:
        lines: L lines, world.
        spans: (L, 2, 3) the parts of them to look along, world.
        velocity: (N, 3) of the camera, to compare speeds; None leaves them out.
        config: `match_global`, and the number of threads; frames are independent.
    """
    first = np.searchsorted(observations.frame, np.arange(len(frames) + 1))
    settings = config.match_global

    def in_frame(frame: int) -> IntArray:
        T_camera_world = frames.T_world_camera[frame].inverse()
        projected = project_segments(spans, T_camera_world, frames)
        image_line, its_rate = _image_lines(lines, frames, frame, velocity)
        current = slice(first[frame], first[frame + 1])
        line, member = match_global_kernels.observations_along(
            projected,
            image_line,
            its_rate,
            observations.segments_px[current],
            observations.normal_speed_px_per_ms[current],
            max_distance_px,
            settings.min_overlap,
            settings.max_speed_difference_px_per_ms if velocity is not None else np.inf,
        )
        return np.stack([line, member + first[frame]])

    found = list(in_order(in_frame, range(len(frames)), worker_count(config)))
    line, member = np.concatenate([np.empty((2, 0), np.int64), *found], axis=1)
    return line, member


def _lengthened(refined: Refined, views: Views) -> FloatArray:
    """(L, 2, 3) the covered part of each line, longer by `LENGTHENING` at each end, world."""
    spans_m = covered_spans(refined.lines, refined.tracks, views)
    extra_m = LENGTHENING * (spans_m[:, 1] - spans_m[:, 0])
    spans_m = spans_m + np.stack([-extra_m, extra_m], axis=-1)
    return plucker.endpoints_from_plucker(refined.lines.direction, refined.lines.moment, spans_m)


def project_segments(segments_world: FloatArray, T_camera_world: SE3, frames: Frames) -> FloatArray:
    """(L, 2, 2) px of 3D segments in one camera; NaN where nothing of them is in its image."""
    return np.asarray(
        match_global_kernels.projected_segments(
            segments_world,
            T_camera_world.rotation,
            T_camera_world.translation,
            frames.K,
            (frames.width, frames.height),
            NEAR_SHARE,
            LEAST_DEPTH_M,
            MIN_PROJECTION_PX,
        )
    )


def _image_lines(
    lines: InfiniteLines, frames: Frames, frame: int, velocity: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """(L, 3) images (a, b, c), a^2 + b^2 = 1, in one frame, and their (L, 3) change a ms.

    The change is that of a camera that moves but does not turn: the frame's events have their
    rotation undone. Without a velocity it is zero.
    """
    R = frames.T_world_camera.rotation[frame]
    centre = frames.T_world_camera.translation[frame]
    moment = plucker.shift_origin(lines.direction, lines.moment, centre) @ R
    to_image = np.linalg.inv(frames.K)
    image = moment @ to_image
    scale = norm(image[:, :2])[:, None]
    if velocity is None:
        return image / scale, np.zeros_like(image)
    moment_rate = -np.cross(velocity[frame] * 1e-3, lines.direction) @ R
    return image / scale, moment_rate @ to_image / scale


def _without_shared(
    refined: Refined, observation_count: int, max_shared_fraction: float
) -> Refined:
    """Of two lines that share most of the smaller one's observations, only the larger one.

    Pairs are judged one by one, from the largest line on; there are no chains of neighbours.
    """
    sizes = refined.tracks.sizes
    shared = _shared_counts(refined.tracks, observation_count)
    rank = np.argsort(np.argsort(-sizes, kind="stable"), kind="stable")
    kept = np.ones(len(refined), dtype=bool)
    for line in np.argsort(rank):
        if not kept[line]:
            continue
        row = slice(shared.indptr[line], shared.indptr[line + 1])
        others = shared.indices[row]
        too_much = shared.data[row] > max_shared_fraction * np.minimum(sizes[line], sizes[others])
        kept[others[too_much & (rank[others] > rank[line])]] = False
    return refined.take(kept)


def _shared_counts(tracks: LineTracks, observation_count: int) -> sparse.csr_matrix:
    """(L, L) how many observations each pair of lines has in common."""
    ones = np.ones(len(tracks.observation), np.int32)
    membership = sparse.csr_matrix(
        (ones, tracks.observation, tracks.offsets), shape=(len(tracks), observation_count)
    )
    return sparse.csr_matrix(membership @ membership.T)


def _exclusive(refined: Refined, views: Views, frames: Frames) -> LineTracks:
    """Each observation with the one line it fits best; large lines get a bonus."""
    tracks = refined.tracks
    line = tracks.track_of_row
    residual_px = np.abs(
        end_residuals_px(
            views.take(tracks.observation),
            refined.lines.direction[line],
            refined.lines.moment[line],
            frames.focal_px,
        )
    ).max(axis=-1)
    cost = residual_px - COMPETITION_PX * np.log(tracks.sizes[line])
    # Lines that fit equally well but for rounding must not share: the first one takes all.
    order = np.lexsort([line, np.round(cost, COST_DECIMALS), tracks.observation])
    first = np.ones(len(order), dtype=bool)
    first[1:] = np.diff(tracks.observation[order]) != 0
    winners = np.sort(order[first])
    return LineTracks.from_rows(line[winners], tracks.observation[winners], len(tracks))
