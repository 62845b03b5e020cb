"""The figures of a map: by whatever truth there is about its scene."""

from __future__ import annotations

import logging
from dataclasses import asdict

import numpy as np

from roel_bench.coverage import coverage_figures
from roel_bench.curve_figures import curve_figures
from roel_bench.results import Figures
from roel_bench.scenes import HeldBackEvents, LineTruth, MapTruth, Scene
from roel_service.arrays import FloatArray
from roel_service.config.presets import preset
from roel_service.errors import InputError, MapFileError
from roel_service.evaluation.maps import distances_to_mesh, evaluate_points, sample_lines
from roel_service.geometry.projection import project, undistortion_table
from roel_service.geometry.segments import point_segment_distance
from roel_service.mapping.frames import Frames, frame_times, frames_at
from roel_service.scene.lines import LineMap
from roel_service.scene.trajectory import Trajectory

logger = logging.getLogger(__name__)

# A held-back event farther than this from every line is of something else: text, curves, noise.
EXPLAINED_PX = 5.0
# Against surfaces alone, precision at these distances takes the place of the IoU [paper, VECtor].
SURFACE_DISTANCES_MM = (5, 10, 20)
# What a map without anything in it would make of the edges.
NOTHING: Figures = {"iou_5": 0.0, "iou_10": 0.0, "iou_20": 0.0, "recall_20": 0.0}


def score(scene: Scene, entities: LineMap | FloatArray) -> Figures:
    """Figures of lines, or of (P, 3) points in m, against the truth of a scene.

    `entity_count` is always among them; `length_m` with lines.

    Raises:
        InputError: points where only lines can be compared.
    """
    common: Figures = {"entity_count": len(entities)}
    if isinstance(entities, LineMap):
        common["length_m"] = float(entities.lengths_m.sum())
    if scene.truth is None:
        return common
    if isinstance(scene.truth, MapTruth):
        return common | _against_surfaces(scene.truth, entities)
    if not isinstance(entities, LineMap) or scene.trajectory is None:
        raise InputError(scene.name, "lines of a scene with poses", "points")
    if isinstance(scene.truth, LineTruth):
        frames = _frames(scene, scene.trajectory)
        ideal_px = undistortion_table(scene.camera)
        return common | coverage_figures(
            scene.truth.segments, entities, frames, scene.events, ideal_px
        )
    return common | held_back_figures(scene, scene.truth, scene.trajectory, entities)


def _against_surfaces(truth: MapTruth, entities: LineMap | FloatArray) -> Figures:
    if len(entities) == 0:
        return dict(NOTHING) if truth.edges is not None else {}
    try:
        samples = sample_lines(entities) if isinstance(entities, LineMap) else entities
    except MapFileError as error:  # a variant without filters may reach for the stars
        logger.warning("no figures: %s", error)
        return dict(NOTHING)
    if truth.edges is not None:
        figures = asdict(evaluate_points(samples, truth.mesh, truth.edges))
        del figures["line_count"]  # the entities are counted already
        if truth.curved_edges is not None:
            figures |= curve_figures(samples, truth.edges.points, truth.curved_edges.points)
        return figures
    distance_mm = 1e3 * distances_to_mesh(samples, truth.mesh)
    precision: Figures = {
        f"surface_precision_{limit}": float((distance_mm <= limit).mean())
        for limit in SURFACE_DISTANCES_MM
    }
    return {
        "accuracy_mm": float(distance_mm.mean()),
        "accuracy_median_mm": float(np.median(distance_mm)),
        "sample_count": len(samples),
        **precision,
    }


def _frames(scene: Scene, trajectory: Trajectory) -> Frames:
    """The frames of the default preset, in which true lines count as seen."""
    times_us = frame_times(trajectory, scene.events.time_range_us, preset("default").frames)
    return frames_at(np.array(times_us, np.int64), trajectory, scene.camera)


def held_back_figures(
    scene: Scene, truth: HeldBackEvents, trajectory: Trajectory, line_map: LineMap
) -> Figures:
    """How near lines lie to events they were not built from.

    Returns:
        `held_back_explained_share` of the events nearer than `EXPLAINED_PX` to a line, and
        `held_back_median_px`, their median distance.
    """
    events = truth.events
    covered = trajectory.covers(events.t_us)
    if len(line_map) == 0 or not covered.any():
        return {"held_back_explained_share": 0.0, "held_back_median_px": None}
    table = undistortion_table(scene.camera)
    xy = table[events.y[covered], events.x[covered]].astype(np.float64)
    T_camera_world = trajectory.interpolate(events.t_us[covered]).inverse()
    nearest = np.full(len(xy), np.inf)
    for segment in line_map.segments:
        in_camera = np.stack([T_camera_world @ end for end in segment], axis=1)
        distance_px = point_segment_distance(xy, project(in_camera, scene.camera.matrix))
        np.fmin(nearest, distance_px, out=nearest)
    explained = nearest < EXPLAINED_PX
    return {
        "held_back_explained_share": float(explained.mean()),
        "held_back_median_px": float(np.median(nearest[explained])) if explained.any() else None,
    }
