"""The poses of a recording are refined, here or on a server."""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from roel_client.local.maps import hosted, read_map
from roel_client.local.recordings import Recording, write_poses
from roel_service.naming import naming

if TYPE_CHECKING:
    from roel_service.config.stages import Config
    from roel_service.progress import ProgressCallback
    from roel_service.scene.trajectory import Trajectory
    from roel_service.v1 import maps_pb2


def refine_poses(
    recording: Recording,
    map_name: str | None,
    config: Config,
    out: Path,
    *,
    estimate_time_offset: bool,
    estimate_intrinsics: bool,
    progress: ProgressCallback,
) -> tuple[dict[str, Any], Trajectory]:
    """Refine the poses of a recording, with its own lines or in a map, and write them.

    Returns:
        What `roel refine-poses` prints, and the poses.

    Raises:
        NoAnswerError: too few lines.
        RoelError: whatever reading and refining raise.
    """
    from roel_service.jobs import refinement

    started_s = time.perf_counter()
    line_map = None if map_name is None else read_map(map_name)
    with naming(recording.names):
        found, report = refinement.refine_poses(
            recording.events,
            recording.trajectory,
            recording.camera,
            config,
            line_map=line_map,
            estimate_time_offset=estimate_time_offset,
            estimate_intrinsics=estimate_intrinsics,
            progress=progress,
        )
    write_poses(found.trajectory, out)
    return {**report, "seconds": time.perf_counter() - started_s}, found.trajectory


def refine_poses_remotely(
    recording: Recording,
    map_name: str | None,
    config: Config,
    out: Path,
    *,
    estimate_time_offset: bool,
    estimate_intrinsics: bool,
    progress: ProgressCallback,
    server: str,
    options: dict[str, Any],
) -> tuple[dict[str, Any], Trajectory]:
    """Let a server refine the poses; as `refine_poses`.

    Args:
        map_name: a file, or a version that the server has.
        server: `HOST:PORT`.
        options: arguments of `Client` beside the address.
    """
    from roel_client.client import Client

    started_s = time.perf_counter()
    with ExitStack() as resources:
        resources.enter_context(naming(recording.names))
        client = resources.enter_context(Client(server, **options))
        version = None
        if map_name is not None:
            version = resources.enter_context(hosted(client, map_name))
        trajectory, answer = client.refine_recording(
            recording.events,
            recording.trajectory,
            recording.camera,
            config,
            version,
            progress,
            estimate_time_offset=estimate_time_offset,
            estimate_intrinsics=estimate_intrinsics,
        )
    write_poses(trajectory, out)
    result = {
        "pose_count": answer.pose_count,
        "line_count": answer.line_count,
        "iterations": answer.iteration_count,
        "converged": answer.converged,
        "cost_initial": answer.cost_initial,
        "cost_final": answer.cost_final,
        "mean_shift_m": answer.mean_shift_m,
        "mean_turn_deg": answer.mean_turn_deg,
        "time_offset_us": answer.time_offset_us,
        "time_offset_sigma_us": _told(answer, "time_offset_sigma_us"),
        "focal_scale": _told(answer, "focal_scale"),
        "focal_scale_sigma": _told(answer, "focal_scale_sigma"),
        "focal_is_applied": answer.focal_is_applied,
        "principal_x_shift_px": _told(answer, "principal_x_shift_px"),
        "principal_x_sigma_px": _told(answer, "principal_x_sigma_px"),
        "principal_x_is_applied": answer.principal_x_is_applied,
        "principal_y_shift_px": _told(answer, "principal_y_shift_px"),
        "principal_y_sigma_px": _told(answer, "principal_y_sigma_px"),
        "principal_y_is_applied": answer.principal_y_is_applied,
        "problems": list(answer.problems),
        "seconds": time.perf_counter() - started_s,
    }
    return result, trajectory


def _told(answer: maps_pb2.RefinePosesResponse, name: str) -> float | None:
    return getattr(answer, name) if answer.HasField(name) else None


def draw_poses(
    recording: Recording, refined: Trajectory, truth_name: str | None, path: Path
) -> None:
    """Write the picture of given and refined poses, and of the true ones if there are any."""
    from roel_service.evaluation import pose_figures
    from roel_service.io.poses import read_trajectory

    truth = None if truth_name is None else read_trajectory(Path(truth_name))
    pose_figures.draw_trajectories(recording.trajectory, refined, truth, path)
