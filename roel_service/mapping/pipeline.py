"""RoEL from events to a line map, one call for each stage of the paper."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from roel_service.config.stages import Config, RefineConfig
from roel_service.mapping.detect import LineDetector, line_detector
from roel_service.mapping.directions import direction_prior
from roel_service.mapping.evidence import Evidence
from roel_service.mapping.frames import (
    Frames,
)
from roel_service.mapping.front_end import lines_of_all_frames
from roel_service.mapping.match_global import reassociate
from roel_service.mapping.match_local import match_adjacent_frames
from roel_service.mapping.match_points import PointLineMatcher, point_matcher
from roel_service.mapping.match_sampled import (
    GeometricMatcher,
    LineMatcher,
    match_sampled_frames,
)
from roel_service.mapping.merge import merge_duplicates
from roel_service.mapping.refine import Refined, refine_lines
from roel_service.mapping.refine_poses import refine_poses
from roel_service.mapping.run import CountedEvents, MappingRun
from roel_service.mapping.triangulate import triangulate_tracks
from roel_service.mapping.trim import trim_to_segments
from roel_service.progress import ProgressCallback, ignore, part_of
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventSource
from roel_service.scene.lines import LineTracks
from roel_service.scene.results import MappingReport, MappingResult, TrackStatus
from roel_service.scene.trajectory import Trajectory

# Share of the whole job that refining the poses takes.
POSES_SHARE = 0.6
# Below every length: with this cap all observations weigh the same.
EQUAL_WEIGHTS_PX = 1.0


def build_line_map(
    events: EventSource,
    trajectory: Trajectory,
    camera: Camera,
    config: Config,
    *,
    detector: LineDetector | None = None,
    matcher: LineMatcher | None = None,
    progress: ProgressCallback = ignore,
) -> MappingResult:
    """Reconstruct a 3D line map from events and poses.

    With `refine.free_poses` the poses are refined first, and the map is that of the refined ones.

    Args:
        events: read front to back, twice with free poses, else once.
        trajectory: poses on the clock of the events; what they do not cover is left out.
        camera: calibration of the sensor.
        config: parameters of every stage, and the seed.
        detector: takes the place of the configured one.
        matcher: finds correspondences for `match_global.method = "sampled"`; takes the place of
            the configured one.
        progress: called often; may raise `Cancelled`.

    Raises:
        ConfigError: the configured matcher lacks its extra or its checkpoint.
        EventsError: no events.
        TrajectoryError: poses that cover less than a tenth of the recording.
        LimitError, NoAnswerError: as `refine_poses`, with free poses.
        Cancelled: as raised by `progress`.
    """
    run = MappingRun(progress)
    if config.refine.free_poses:
        before = part_of(progress, 0.0, POSES_SHARE)
        poses = refine_poses(events, trajectory, camera, config, progress=before)
        trajectory = poses.trajectory
        run = MappingRun(part_of(progress, POSES_SHARE, 1.0), seconds=poses.report.seconds)
    rng = np.random.default_rng(config.runtime.seed)
    counted = CountedEvents(events, trajectory)
    detector = detector or line_detector(config.detect)
    needs_points = matcher is None and config.match_global.matches_points
    points = point_matcher(config.match_global) if needs_points else None

    detected = lines_of_all_frames(counted, trajectory, camera, config, detector, run)
    frames, observations, evidence = detected.frames, detected.observations, detected.evidence
    counted.check_coverage()
    with run.stage("match_local"):
        tracks = match_adjacent_frames(
            observations,
            frames,
            config.match_local,
            rotation_is_undone=config.frames.compensate_rotation,
        )
    if config.match_global.method == "sampled":
        with run.stage("match_global"):
            matcher = matcher or (
                PointLineMatcher(points, detected.images, evidence.views, config.match_global)
                if points
                else GeometricMatcher(tracks, evidence.views, frames, config)
            )
            tracks = match_sampled_frames(tracks, evidence.views, frames, config, matcher, run.step)
    with run.stage("triangulate"):
        refined = _triangulate(tracks, evidence, frames, config, rng, run)
    if config.match_global.method == "reassociate":
        with run.stage("match_global"):
            refined = reassociate(
                refined, evidence, observations, frames, trajectory, config, run.step
            )
    with run.stage("refine"):
        prior = direction_prior(refined, config.refine)
        refined = run.without_diverged(
            refine_lines(refined.lines, refined.tracks, evidence, frames, config.refine, prior)
        )
    with run.stage("trim"):
        line_map, dropped = trim_to_segments(refined, evidence.views, frames, config.trim)
        run.count(dropped)
    run.count([TrackStatus.TRIANGULATED] * len(line_map))
    return MappingResult(
        line_map=line_map,
        trajectory=trajectory,
        report=MappingReport(
            frame_count=len(frames),
            event_count=counted.covered_count,
            left_out_event_count=counted.total_count - counted.covered_count,
            observation_count=len(observations),
            track_status_count=dict(run.statuses),
            seconds=run.seconds,
        ),
    )


def _triangulate(
    tracks: LineTracks,
    evidence: Evidence,
    frames: Frames,
    config: Config,
    rng: np.random.Generator,
    run: MappingRun,
) -> Refined:
    """First 3D lines, refined over their inliers and, if configured, without duplicates."""
    found = triangulate_tracks(tracks, evidence.views, frames, config.triangulate, rng)
    run.count([status for status in found.statuses if status is not TrackStatus.TRIANGULATED])
    refined = run.without_diverged(
        refine_lines(found.lines, found.tracks, evidence, frames, _triangulation_cost(config))
    )
    if not config.triangulate.merge:
        return refined
    refined, merged = merge_duplicates(refined, evidence.views, frames, config.triangulate)
    run.count(merged)
    return refined


def _triangulation_cost(config: Config) -> RefineConfig:
    """What refines a hypothesis over its inliers.

    With the paper's gate it is the paper's cost: the sum of the line term alone, unweighted.
    """
    steps = config.triangulate.iteration_count
    if config.triangulate.gate == "pixel":
        return replace(config.refine, iteration_count=steps)
    return replace(
        config.refine,
        residual="grassmann",
        loss="squared",
        event_weight=0.0,
        max_length_weight_px=EQUAL_WEIGHTS_PX,
        iteration_count=steps,
    )
