"""`roel map build`, `roel map info`, `roel map import`, `roel map export`."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

from roel_client.cli.configuration import (
    add_config_options,
    add_seed_option,
    effective_config,
    seed_table,
)
from roel_client.cli.output import print_result, progress_bar, to_json
from roel_client.cli.parser import (
    Command,
    Parser,
    Subparsers,
    UsageError,
    command,
    command_group,
    size,
    suffixed,
)
from roel_client.cli.process import interruptible
from roel_client.cli.servers import add_server_options, server_options
from roel_client.cli.staging import Staged
from roel_service.config.load import Tables

EXPORT_SUFFIXES = (".npz", ".ply", ".obj", ".json", ".csv", ".dxf")


def add_commands(subparsers: Subparsers) -> None:
    """Declare the commands below `map`."""
    group = command_group(subparsers, "map", "build, look at and convert line maps")
    _add_build(group)
    _add_info(group)
    _add_import(group)
    _add_export(group)


def _add_build(group: Subparsers) -> None:
    build = Command(
        run=build_map,
        inputs=("events", "poses", "camera", "config"),
        outputs=("out", "poses_out", "report", "plot"),
    )
    parser = command(group, "build", "build a map from events and camera poses", build)
    add_recording_options(parser)
    parser.add_argument("--out", required=True, metavar="MAP.rlm", help="the map")
    add_config_options(parser)
    parser.add_argument(
        "--refine-poses", action="store_true", help="refine the poses together with the lines"
    )
    parser.add_argument(
        "--poses-out", metavar="FILE", help="the refined poses as TUM text (with --refine-poses)"
    )
    parser.add_argument("--report", metavar="FILE.json", help="how the build went")
    parser.add_argument(
        "--plot",
        type=suffixed(".png"),
        metavar="FILE.png",
        help="the map over the events and from above",
    )
    add_seed_option(parser)
    add_server_options(parser, required=False, what="let this server build the map")
    parser.add_argument("--json", action="store_true", help="print the report as JSON")


def add_recording_options(parser: Parser) -> None:
    """The files that make up a recording."""
    parser.add_argument(
        "--events",
        required=True,
        metavar="FILE",
        help="HDF5, NPZ, RAW (EVT2, EVT3), DAT, or text `t_seconds x y p`",
    )
    parser.add_argument(
        "--poses", required=True, metavar="FILE", help="TUM text `t tx ty tz qx qy qz qw`"
    )
    parser.add_argument(
        "--camera", required=True, metavar="FILE", help="calibration as JSON, YAML or one line"
    )
    parser.add_argument(
        "--sensor-size", type=size, metavar="WxH", help="for a calibration that does not say it"
    )


def build_map(options: argparse.Namespace, staged: Staged) -> None:
    """Build a map here or on a server, and write it with its report and picture."""
    from roel_client.local import building, recordings

    started_s = time.perf_counter()
    if options.poses_out is not None:
        _check_poses_out(options)
    config = effective_config(options, {**seed_table(options), **poses_table(options)})
    recording = recordings.open_recording(
        options.events, options.poses, options.camera, options.sensor_size
    )
    with progress_bar() as progress:
        if options.server is None:
            built = building.build_map(recording, config, progress)
        else:
            # A signal must reach the client, which then ends the build on the server too.
            with interruptible():
                built = building.build_map_remotely(
                    recording, config, progress, options.server, server_options(options)
                )
    staged["out"].write_bytes(built.rlm_bytes)
    if "poses_out" in staged:
        recordings.write_poses(built.trajectory or recording.trajectory, staged["poses_out"])
    report = {**built.report, "seconds_total": time.perf_counter() - started_s}
    if "report" in staged:
        staged["report"].write_text(to_json(report) + "\n", encoding="utf-8")
    if "plot" in staged:
        building.draw_map(built, recording, staged["plot"])
    print_result(report, _told(report, options.out), as_json=options.json)


def _check_poses_out(options: argparse.Namespace) -> None:
    if not options.refine_poses:
        raise UsageError("--poses-out", "--refine-poses beside it", options.poses_out)


def poses_table(options: argparse.Namespace) -> Tables:
    """What `--refine-poses` changes of the configuration."""
    return {"refine": {"free_poses": True}} if options.refine_poses else {}


def _told(report: dict[str, Any], out: str) -> str:
    return (
        f"{out}: {report['line_count']} lines from {report['event_count']} events "
        f"in {report['frame_count']} frames; {report['seconds_total']:.1f} s, "
        f"at most {report['peak_rss_mib']:.0f} MiB"
    )


def _add_info(group: Subparsers) -> None:
    info = Command(run=show_info, inputs=("map",))
    parser = command(group, "info", "say what a map file holds", info)
    parser.add_argument("map", metavar="MAP.rlm")
    parser.add_argument("--json", action="store_true", help="print as JSON")


def show_info(options: argparse.Namespace, staged: Staged) -> None:
    """Print what a map file holds."""
    from roel_client.local import maps

    info = maps.describe_map(options.map)
    text = "\n".join(f"{key:<16}{_shown(value)}" for key, value in info.items())
    print_result(info, text, as_json=options.json)


def _shown(value: Any) -> str:
    if isinstance(value, list):
        return " ".join(_shown(item) for item in value)
    return f"{value:.3f}" if isinstance(value, float) else str(value)


def _add_import(group: Subparsers) -> None:
    what = Command(run=import_map, inputs=("lines",), outputs=("out",))
    parser = command(group, "import", "make a map of lines from another program", what)
    parser.add_argument(
        "lines",
        metavar="LINES",
        help="NPZ, JSON, CSV, OBJ, PLY, DXF, or LIMAP's tracks (text or ZIP)",
    )
    parser.add_argument("--out", required=True, type=suffixed(".rlm"), metavar="MAP.rlm")


def import_map(options: argparse.Namespace, staged: Staged) -> None:
    """Write lines of another program as a map file."""
    from roel_client.local import maps

    name, kept_count, dropped_count = maps.import_map(options.lines, staged["out"])
    dropped = f", {dropped_count} without length left out" if dropped_count else ""
    print_result({}, f"{options.out}: {kept_count} lines from {name}{dropped}", as_json=False)


def _add_export(group: Subparsers) -> None:
    export = Command(run=export_map, inputs=("map",), outputs=("out",))
    parser = command(group, "export", "write a map in another format", export)
    parser.add_argument("map", metavar="MAP.rlm")
    parser.add_argument(
        "--out",
        required=True,
        type=suffixed(*EXPORT_SUFFIXES),
        metavar="FILE",
        help="its suffix picks the format: " + " ".join(EXPORT_SUFFIXES),
    )


def export_map(options: argparse.Namespace, staged: Staged) -> None:
    """Write a map in the format that the output's suffix names."""
    from roel_client.local import maps

    maps.export_map(options.map, Path(staged["out"]))
