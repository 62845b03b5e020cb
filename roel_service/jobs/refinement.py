"""Poses of a recording, refined: the one step that the command line and the children share."""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import numpy as np

from roel_service.config.stages import Config
from roel_service.geometry.se3 import rotation_angle
from roel_service.jobs.build import build_map, built_version
from roel_service.jobs.refine_inputs import RefineParameters
from roel_service.jobs.task import Tell
from roel_service.mapping import refine_poses as poses
from roel_service.mapping.pipeline import POSES_SHARE
from roel_service.progress import ProgressCallback, ignore, part_of
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventSource
from roel_service.scene.lines import LineMap
from roel_service.scene.results import CalibrationOffset, IntrinsicsEstimate, PoseResult
from roel_service.scene.trajectory import Trajectory
from roel_service.store.refinements import RefinedPoses
from roel_service.wire.nouns import trajectory_to_proto


def refine_poses(
    events: EventSource,
    trajectory: Trajectory,
    camera: Camera,
    config: Config,
    *,
    line_map: LineMap | None = None,
    estimate_time_offset: bool = False,
    estimate_intrinsics: bool = False,
    progress: ProgressCallback = ignore,
) -> tuple[PoseResult, dict[str, Any]]:
    """Refined poses, and how that went with the keys that `roel refine-poses` prints.

    Raises:
        NoAnswerError: too few lines.
        RoelError: whatever reading and refining raise.
    """
    started_s = time.perf_counter()
    found = poses.refine_poses(
        events,
        trajectory,
        camera,
        config,
        line_map=line_map,
        estimate_time_offset=estimate_time_offset,
        estimate_intrinsics=estimate_intrinsics,
        progress=progress,
    )
    return found, _report(found, trajectory, time.perf_counter() - started_s)


def run_refinement(parameters: RefineParameters, tell: Tell) -> RefinedPoses:
    """Entry point of a refinement in a child; errors as of `refine_poses` and `build_map`."""
    events, trajectory, camera = parameters.recording.open()
    config, fixed_map = parameters.recording.config, parameters.fixed_map
    found, report = refine_poses(
        events,
        parameters.trajectory or trajectory,
        camera,
        config,
        line_map=None if fixed_map is None else fixed_map.line_map(),
        estimate_time_offset=parameters.estimate_time_offset,
        estimate_intrinsics=parameters.estimate_intrinsics,
        progress=part_of(tell, 0.0, POSES_SHARE) if parameters.makes_version else tell,
    )
    trajectory, intrinsics = found.trajectory, found.report.intrinsics
    camera = camera if intrinsics is None else intrinsics.camera
    version = None
    if parameters.makes_version:
        # The poses are as good as they get.
        fixed = dataclasses.replace(
            config, refine=dataclasses.replace(config.refine, free_poses=False)
        )
        rest = part_of(tell, POSES_SHARE, 1.0)
        built = build_map(events, trajectory, camera, fixed, rest)
        version = built_version(built, with_poses=True)
    message = trajectory_to_proto(trajectory)
    return RefinedPoses(
        trajectory=bytes(message.SerializeToString(deterministic=True)),
        report=report,
        version=version,
    )


def _report(found: PoseResult, given: Trajectory, seconds: float) -> dict[str, Any]:
    before, after = given.T_world_camera, found.trajectory.T_world_camera
    shift_m = np.linalg.norm(after.translation - before.translation, axis=1)
    turn_rad = rotation_angle(np.swapaxes(before.rotation, -1, -2) @ after.rotation)
    sigma_us = found.report.time_offset_sigma_us
    return {
        "pose_count": len(found.trajectory),
        "line_count": found.report.line_count,
        "iterations": found.report.iteration_count,
        "converged": found.report.converged,
        "cost_initial": found.report.cost_initial,
        "cost_final": found.report.cost_final,
        "mean_shift_m": float(shift_m.mean()),
        "mean_turn_deg": float(np.degrees(turn_rad).mean()),
        "time_offset_us": found.report.time_offset_us,
        "time_offset_sigma_us": sigma_us if np.isfinite(sigma_us) else None,
        **_calibration(found.report.intrinsics),
        "problems": [problem.value for problem in found.report.problems],
        "seconds": seconds,
    }


def _calibration(found: IntrinsicsEstimate | None) -> dict[str, Any]:
    focal, x, y = (
        (None, None, None) if found is None else (found.focal, found.principal_x, found.principal_y)
    )
    return {
        "focal_scale": None if focal is None else 1.0 + focal.change,
        "focal_scale_sigma": _sigma(focal),
        "focal_is_applied": _is_applied(focal),
        "principal_x_shift_px": None if x is None else x.change,
        "principal_x_sigma_px": _sigma(x),
        "principal_x_is_applied": _is_applied(x),
        "principal_y_shift_px": None if y is None else y.change,
        "principal_y_sigma_px": _sigma(y),
        "principal_y_is_applied": _is_applied(y),
    }


def _sigma(error: CalibrationOffset | None) -> float | None:
    return None if error is None or not np.isfinite(error.sigma) else error.sigma


def _is_applied(error: CalibrationOffset | None) -> bool:
    return error is not None and error.is_applied
