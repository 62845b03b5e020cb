"""First lines: observations matched between frames, and triangulated."""

from __future__ import annotations

import numpy as np

from roel_service.config.stages import Config
from roel_service.errors import NoAnswerError
from roel_service.mapping.cached_stages import triangulation_cost
from roel_service.mapping.evidence import Evidence
from roel_service.mapping.frames import Frames
from roel_service.mapping.front_end import Detected, worker_count
from roel_service.mapping.match_local import match_adjacent_frames
from roel_service.mapping.match_points import PointLineMatcher, PointMatcher
from roel_service.mapping.match_sampled import (
    GeometricMatcher,
    LineMatcher,
    match_sampled_frames,
)
from roel_service.mapping.merge import merge_duplicates
from roel_service.mapping.refine import Refined, refine_lines
from roel_service.mapping.run import MappingRun
from roel_service.mapping.triangulate import triangulate_tracks
from roel_service.scene.lines import LineTracks
from roel_service.scene.results import TrackStatus

# Fewer lines than this do not hold six unknowns.
MIN_LINE_COUNT = 6


def check_line_count(refined: Refined) -> None:
    """Raise `NoAnswerError` if the lines do not hold the six unknowns of a pose."""
    if len(refined) < MIN_LINE_COUNT:
        expected = f"at least {MIN_LINE_COUNT} lines in view"
        raise NoAnswerError("poses", expected, f"{len(refined)}", reason="TOO_FEW_LINES")


def matched_tracks(
    detected: Detected,
    config: Config,
    matcher: LineMatcher | None,
    points: PointMatcher | None,
    run: MappingRun,
) -> LineTracks:
    """Observations of adjacent frames and, if configured, of distant ones that show one line."""
    frames, views = detected.frames, detected.evidence.views
    with run.stage("match_local"):
        tracks = match_adjacent_frames(
            detected.observations,
            frames,
            config.match_local,
            rotation_is_undone=config.frames.compensate_rotation,
        )
    if config.match_global.method != "sampled":
        return tracks
    with run.stage("match_global"):
        matcher = matcher or (
            PointLineMatcher(points, detected.images, views, config.match_global)
            if points
            else GeometricMatcher(tracks, views, frames, config)
        )
        return match_sampled_frames(tracks, views, frames, config, matcher, run.step)


def triangulated_lines(
    tracks: LineTracks,
    evidence: Evidence,
    frames: Frames,
    config: Config,
    rng: np.random.Generator,
    run: MappingRun,
) -> Refined:
    """First 3D lines, refined over their inliers and, if configured, without duplicates."""
    found = triangulate_tracks(
        tracks,
        evidence.views,
        frames,
        config.triangulate,
        rng,
        worker_count=worker_count(config),
    )
    run.count([status for status in found.statuses if status is not TrackStatus.TRIANGULATED])
    refined = run.without_diverged(
        refine_lines(
            found.lines,
            found.tracks,
            evidence,
            frames,
            triangulation_cost(config),
            worker_count=worker_count(config),
        )
    )
    if not config.triangulate.merge:
        return refined
    refined, merged = merge_duplicates(refined, evidence.views, frames, config.triangulate)
    run.count(merged)
    return refined
