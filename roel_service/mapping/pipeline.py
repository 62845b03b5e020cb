"""RoEL from events to a line map, one call for each stage of the paper."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from roel_service.config.stages import Config
from roel_service.mapping.cached_stages import CachedStages
from roel_service.mapping.corners import held_at_corners
from roel_service.mapping.curves import with_curves
from roel_service.mapping.detect import LineDetector, line_detector
from roel_service.mapping.directions import direction_prior
from roel_service.mapping.first_lines import matched_tracks, triangulated_lines
from roel_service.mapping.front_end import (
    NO_KNOWN_FRAMES,
    Detected,
    KnownFrames,
    lines_of_all_frames,
    worker_count,
)
from roel_service.mapping.match_global import reassociate
from roel_service.mapping.match_points import point_matcher
from roel_service.mapping.match_sampled import LineMatcher
from roel_service.mapping.refine import Refined, refine_lines
from roel_service.mapping.refine_poses import in_likeliest_world, refine_poses
from roel_service.mapping.run import CountedEvents, MappingRun
from roel_service.mapping.stage_cache import NoCache, StageCache
from roel_service.mapping.trim import trim_to_segments
from roel_service.progress import ProgressCallback, ignore, part_of
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventSource
from roel_service.scene.lines import LineMap
from roel_service.scene.results import MappingReport, MappingResult, TrackStatus
from roel_service.scene.trajectory import Trajectory

# Share of the whole job that refining the poses takes.
POSES_SHARE = 0.6

NO_CACHE = NoCache()


def build_line_map(
    events: EventSource,
    trajectory: Trajectory,
    camera: Camera,
    config: Config,
    *,
    detector: LineDetector | None = None,
    matcher: LineMatcher | None = None,
    progress: ProgressCallback = ignore,
    cache: StageCache = NO_CACHE,
    known: KnownFrames = NO_KNOWN_FRAMES,
    on_preview: Callable[[LineMap], None] | None = None,
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
        cache: has what stages found in an earlier job on the same recording, and gets what they
            find in this one; only for the configured detector and matcher.
        known: frames that were looked at before, with the same configuration.
        on_preview: gets the lines as they are before re-association and refinement.

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
        trajectory = in_likeliest_world(poses.trajectory, trajectory, config.refine)
        # What was found before, was found from other poses.
        cache, known = NO_CACHE, NO_KNOWN_FRAMES
        run = MappingRun(part_of(progress, POSES_SHARE, 1.0), seconds=poses.report.seconds)
    rng = np.random.default_rng(config.runtime.seed)
    counted = CountedEvents(events, trajectory)
    detector = detector or line_detector(config.detect)
    needs_points = matcher is None and config.match_global.matches_points
    points = point_matcher(config.match_global) if needs_points else None

    def detect() -> Detected:
        return lines_of_all_frames(counted, trajectory, camera, config, detector, run, known)

    def triangulate() -> Refined:
        tracks = matched_tracks(detected, config, matcher, points, run)
        with run.stage("triangulate"):
            return triangulated_lines(tracks, evidence, frames, config, rng, run)

    def associate_again() -> Refined:
        with run.stage("match_global"):
            return reassociate(
                refined, evidence, observations, frames, trajectory, config, run.step
            )

    if config.curves.method != "none":
        cache = NO_CACHE  # it does not keep the pieces of edges
    stages = CachedStages(run, cache, config)
    detected = stages.detected(detect, counted, trajectory, camera)
    frames, observations, evidence = detected.frames, detected.observations, detected.evidence
    counted.check_coverage()
    refined = stages.triangulated(triangulate)
    if on_preview is not None:
        on_preview(trim_to_segments(refined, evidence.views, frames, config.trim)[0])
    if config.match_global.method == "reassociate":
        refined = stages.associated(associate_again)
    with run.stage("refine"):
        workers = worker_count(config)
        prior = direction_prior(refined, config.refine, workers)
        refined = run.without_diverged(
            refine_lines(
                refined.lines,
                refined.tracks,
                evidence,
                frames,
                config.refine,
                prior,
                worker_count=workers,
            )
        )
        refined = run.without_diverged(held_at_corners(refined, evidence, frames, config))
    with run.stage("trim"):
        line_map, dropped = trim_to_segments(refined, evidence.views, frames, config.trim)
        run.count(dropped)
        run.count([TrackStatus.TRIANGULATED] * len(line_map))
        if config.curves.method != "none":
            line_map = with_curves(line_map, detected.pieces, frames, trajectory, config, run.step)
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
