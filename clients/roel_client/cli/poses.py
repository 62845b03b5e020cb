"""`roel refine-poses`."""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np

from roel_client.cli.configuration import (
    add_config_options,
    add_seed_option,
    effective_config,
    seed_table,
)
from roel_client.cli.maps import add_recording_options
from roel_client.cli.output import print_result, progress_bar
from roel_client.cli.parser import Command, Subparsers, command
from roel_client.cli.staging import Staged
from roel_service.geometry.se3 import rotation_angle
from roel_service.scene.results import PoseResult
from roel_service.scene.trajectory import Trajectory


def add_commands(subparsers: Subparsers) -> None:
    """Declare `refine-poses`."""
    what = Command(
        run=refine_poses, inputs=("events", "poses", "camera", "map", "config"), outputs=("out",)
    )
    parser = command(subparsers, "refine-poses", "make noisy camera poses better", what)
    add_recording_options(parser)
    parser.add_argument("--map", metavar="MAP.rlm", help="hold the poses to this map's lines")
    parser.add_argument("--out", required=True, metavar="POSES.txt", help="TUM text")
    add_config_options(parser)
    add_seed_option(parser)
    parser.add_argument("--json", action="store_true", help="print as JSON")


def refine_poses(options: argparse.Namespace, staged: Staged) -> None:
    """Refine the poses of a recording, and write them at their own times."""
    from roel_client import local

    started_s = time.perf_counter()
    config = effective_config(options, seed_table(options))
    recording = local.open_recording(
        options.events, options.poses, options.camera, options.sensor_size
    )
    with progress_bar() as progress:
        found = local.refine_poses(recording, options.map, config, progress)
    local.write_poses(found.trajectory, staged["out"])
    result = _result(found, recording.trajectory, time.perf_counter() - started_s)
    print_result(result, _told(result, options.out), as_json=options.json)


def _result(found: PoseResult, given: Trajectory, seconds: float) -> dict[str, Any]:
    before, after = given.T_world_camera, found.trajectory.T_world_camera
    shift_m = np.linalg.norm(after.translation - before.translation, axis=1)
    turn_rad = rotation_angle(np.swapaxes(before.rotation, -1, -2) @ after.rotation)
    return {
        "pose_count": len(given),
        "line_count": found.report.line_count,
        "iterations": found.report.iteration_count,
        "converged": found.report.converged,
        "cost_initial": found.report.cost_initial,
        "cost_final": found.report.cost_final,
        "mean_shift_m": float(shift_m.mean()),
        "mean_turn_deg": float(np.degrees(turn_rad).mean()),
        "seconds": seconds,
    }


def _told(result: dict[str, Any], out: str) -> str:
    return (
        f"{out}: {result['pose_count']} poses moved by {1e3 * result['mean_shift_m']:.1f} mm and "
        f"{result['mean_turn_deg']:.2f} degrees in the mean, held by {result['line_count']} lines; "
        f"{result['seconds']:.1f} s"
    )
