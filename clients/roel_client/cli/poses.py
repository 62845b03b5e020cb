"""`roel refine-poses`."""

from __future__ import annotations

import argparse
from typing import Any

from roel_client.cli.configuration import (
    add_config_options,
    add_seed_option,
    effective_config,
    seed_table,
)
from roel_client.cli.maps import add_recording_options
from roel_client.cli.output import print_result, progress_bar
from roel_client.cli.parser import Command, Subparsers, command, suffixed
from roel_client.cli.process import interruptible
from roel_client.cli.servers import add_server_options, server_options
from roel_client.cli.staging import Staged


def add_commands(subparsers: Subparsers) -> None:
    """Declare `refine-poses`."""
    what = Command(
        run=refine_poses,
        inputs=("events", "poses", "camera", "map", "truth", "config"),
        outputs=("out", "plot"),
    )
    parser = command(subparsers, "refine-poses", "make noisy camera poses better", what)
    add_recording_options(parser)
    parser.add_argument("--map", metavar="MAP.rlm", help="hold the poses to this map's lines")
    parser.add_argument("--out", required=True, metavar="POSES.txt", help="TUM text")
    parser.add_argument(
        "--estimate-time-offset",
        action="store_true",
        help="the clock of the poses may run beside that of the events; OUT is on the latter",
    )
    parser.add_argument(
        "--estimate-intrinsics",
        action="store_true",
        help="focal length and principal point may be off, by up to 4 %% of the former; "
        "takes fourteen times as long, or up to three times that if they are",
    )
    parser.add_argument(
        "--plot",
        type=suffixed(".png"),
        metavar="FILE.png",
        help="the given and the refined trajectory",
    )
    parser.add_argument("--truth", metavar="FILE", help="true poses, for the picture")
    add_config_options(parser)
    add_seed_option(parser)
    add_server_options(parser, required=False, what="let this server refine the poses")
    parser.add_argument("--json", action="store_true", help="print as JSON")


def refine_poses(options: argparse.Namespace, staged: Staged) -> None:
    """Refine the poses of a recording, and write them at their own times."""
    from roel_client.local import poses, recordings

    config = effective_config(options, seed_table(options))
    recording = recordings.open_recording(
        options.events, options.poses, options.camera, options.sensor_size
    )
    with progress_bar() as progress:
        if options.server is None:
            result, refined = poses.refine_poses(
                recording,
                options.map,
                config,
                staged["out"],
                estimate_time_offset=options.estimate_time_offset,
                estimate_intrinsics=options.estimate_intrinsics,
                progress=progress,
            )
        else:
            # A signal must reach the client, which then ends the work on the server too.
            with interruptible():
                result, refined = poses.refine_poses_remotely(
                    recording,
                    options.map,
                    config,
                    staged["out"],
                    estimate_time_offset=options.estimate_time_offset,
                    estimate_intrinsics=options.estimate_intrinsics,
                    progress=progress,
                    server=options.server,
                    options=server_options(options),
                )
    if "plot" in staged:
        poses.draw_poses(recording, refined, options.truth, staged["plot"])
    print_result(result, _told(result, options.out), as_json=options.json)


def _told(result: dict[str, Any], out: str) -> str:
    mended = ""
    if result["focal_is_applied"]:
        mended += f"; focal length times {result['focal_scale']:.4f}"
    for axis in ("x", "y"):
        if result[f"principal_{axis}_is_applied"]:
            mended += (
                f"; principal point {result[f'principal_{axis}_shift_px']:+.1f} px along {axis}"
            )
    problems = "".join(f"; {problem}" for problem in result["problems"])
    return (
        f"{out}: {result['pose_count']} poses moved by {1e3 * result['mean_shift_m']:.1f} mm and "
        f"{result['mean_turn_deg']:.2f} degrees in the mean, held by {result['line_count']} lines; "
        f"{result['seconds']:.1f} s{mended}{problems}"
    )
