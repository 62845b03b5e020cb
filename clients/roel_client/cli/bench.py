"""`roel bench`: mapping, registration, localization."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from roel_client.cli.output import print_result, progress_bar
from roel_client.cli.parser import (
    Command,
    Subparsers,
    command,
    command_group,
    integer,
    one_of,
    suffixed,
)
from roel_client.cli.staging import Staged

LOCALIZATION_METHODS = ("default", "default-unjudged", "fgpl", "fgpl-released")
LOCALIZATION_PROTOCOLS = (
    "here", "moved", "yaw_5", "yaw_17", "elsewhere", "prior", "width_512", "width_1024",
    "width_4096", "quality_10", "quality_30", "quality_50", "quality_70",
)  # fmt: skip
SUITES = ("quick", "presets", "ablation", "noise", "front-end", "peers", "curves", "full")


def add_commands(subparsers: Subparsers) -> None:
    """Declare the commands below `bench`."""
    group = command_group(subparsers, "bench", "measure how good the results are")
    _add_mapping(group)
    _add_registration(group)
    _add_localization(group)
    _add_poses(group)


def _add_mapping(group: Subparsers) -> None:
    # The folder is no staged output: it keeps the rows of an interrupted run, for the next one.
    what = Command(run=bench_mapping)
    parser = command(group, "mapping", "maps by presets, ablations and peers against truth", what)
    parser.add_argument(
        "--out",
        required=True,
        metavar="DIR",
        help="folder of mapping.json, mapping.md and pictures; rows that it holds are not run again",
    )
    parser.add_argument(
        "--suite",
        default="quick",
        type=one_of(*SUITES),
        metavar="NAME",
        help=f"one of {', '.join(SUITES)}; default: quick",
    )
    parser.add_argument("--scenes", nargs="+", metavar="NAME", help="only these scenes")
    parser.add_argument("--variants", nargs="+", metavar="NAME", help="only these methods")
    parser.add_argument(
        "--data", metavar="DIR", help="folder of recordings; default: the environment's ROEL_DATA"
    )
    parser.add_argument(
        "--rooms", metavar="DIR", help="folder that keeps simulated rooms; default: OUT/rooms"
    )
    parser.add_argument("--json", action="store_true", help="print all rows as JSON")


def bench_mapping(options: argparse.Namespace, staged: Staged) -> None:
    """Run a suite and print its rows."""
    from roel_client.local import benchmarks

    out = Path(options.out)
    data = options.data or os.environ.get("ROEL_DATA")
    with progress_bar() as progress:
        document, text = benchmarks.bench_mapping(
            out,
            suite=options.suite,
            scenes=tuple(options.scenes) if options.scenes else None,
            methods=tuple(options.variants) if options.variants else None,
            data=Path(data) if data else None,
            rooms=Path(options.rooms) if options.rooms else out / "rooms",
            progress=progress,
        )
    print_result(document, text.rstrip("\n"), as_json=options.json)


def _add_registration(group: Subparsers) -> None:
    what = Command(run=bench_registration)
    parser = command(group, "registration", "maps against clouds of their places", what)
    parser.add_argument(
        "--place",
        action="append",
        nargs=2,
        default=[],
        metavar=("MAP", "TARGET"),
        help="a map and the cloud, or another map, of the same place in the same frame; may be repeated",
    )
    parser.add_argument(
        "--large",
        action="store_true",
        help="all places side by side too, cut to 2,500 lines and 400,000 points",
    )
    parser.add_argument(
        "--scans", metavar="DIR", help="folder of real scans with transforms between them"
    )
    _add_trial_options(parser)


def _add_trial_options(parser: argparse.ArgumentParser) -> None:
    # The file is no staged output: it keeps the trials of an interrupted run, for the next one.
    parser.add_argument(
        "--out",
        required=True,
        type=suffixed(".json"),
        metavar="FILE.json",
        help="every trial; what it holds is not run again",
    )
    parser.add_argument(
        "--symmetric",
        type=integer(0, 1000),
        default=0,
        metavar="N",
        help="so many symmetric rooms of boxes, made by chance",
    )
    parser.add_argument(
        "--trials", type=integer(1, 1000), metavar="N", help="at most so many of each kind"
    )
    parser.add_argument("--json", action="store_true", help="print all trials as JSON")


def bench_registration(options: argparse.Namespace, staged: Staged) -> None:
    """Run all protocols on all places and print their tables."""
    from roel_client.local import benchmarks

    with progress_bar() as progress:
        document, text = benchmarks.bench_registration(
            Path(options.out),
            rooms=[(line_map, cloud) for line_map, cloud in options.place],
            has_large=options.large,
            symmetric_count=options.symmetric,
            scans=Path(options.scans) if options.scans else None,
            max_count=options.trials,
            progress=progress,
        )
    print_result(document, text.rstrip("\n"), as_json=options.json)


def _add_localization(group: Subparsers) -> None:
    what = Command(run=bench_localization)
    parser = command(group, "localization", "panoramas in maps of their places", what)
    parser.add_argument(
        "--room",
        action="append",
        nargs=2,
        default=[],
        metavar=("MAP", "PANOS"),
        help="a map, and a folder of panoramas of the same room with their poses; may be repeated",
    )
    parser.add_argument(
        "--house",
        nargs=2,
        metavar=("LINES.npz", "PANOS"),
        help="lines of a house with the names of their rooms, and a folder of photographs",
    )
    parser.add_argument(
        "--protocols",
        nargs="+",
        default=[],
        type=one_of(*LOCALIZATION_PROTOCOLS),
        metavar="NAME",
        help=f"only these of {', '.join(LOCALIZATION_PROTOCOLS)}",
    )
    parser.add_argument(
        "--methods",
        nargs="+",
        default=[],
        type=one_of(*LOCALIZATION_METHODS),
        metavar="NAME",
        help=f"only these of {', '.join(LOCALIZATION_METHODS)}",
    )
    _add_trial_options(parser)
    parser.add_argument("--again", action="store_true", help="run what the file holds, too")


def bench_localization(options: argparse.Namespace, staged: Staged) -> None:
    """Run the protocols on all places and print their tables."""
    from roel_client.local import benchmarks

    with progress_bar() as progress:
        document, text = benchmarks.bench_localization(
            Path(options.out),
            rooms=[(line_map, folder) for line_map, folder in options.room],
            house=tuple(options.house) if options.house else None,
            symmetric_count=options.symmetric,
            protocols=options.protocols,
            methods=options.methods,
            max_count=options.trials,
            again=options.again,
            progress=progress,
        )
    print_result(document, text.rstrip("\n"), as_json=options.json)


def _add_poses(group: Subparsers) -> None:
    # The file is no staged output: it keeps the rows of an interrupted run, for the next one.
    what = Command(run=bench_poses)
    parser = command(group, "poses", "refined poses of the paper's cube and of rooms", what)
    parser.add_argument(
        "--out",
        required=True,
        type=suffixed(".json"),
        metavar="FILE.json",
        help="rows; those that it holds are not run again; roel_bench.poses_report makes the page",
    )
    parser.add_argument(
        "--scenes", nargs="*", default=("room_11", "room_12"), metavar="NAME", help="rooms"
    )
    parser.add_argument(
        "--draws",
        type=integer(0, 1000),
        default=5,
        metavar="N",
        help="draws of noise for the cube; 0 leaves it out",
    )
    parser.add_argument(
        "--data", metavar="DIR", help="folder of recordings; default: the environment's ROEL_DATA"
    )
    parser.add_argument(
        "--rooms",
        required=True,
        metavar="DIR",
        help="folder that keeps the simulated rooms and the cube",
    )
    parser.add_argument("--json", action="store_true", help="print all rows as JSON")


def bench_poses(options: argparse.Namespace, staged: Staged) -> None:
    """Run the benchmark of poses and print its page."""
    from roel_client.local import benchmarks

    data = options.data or os.environ.get("ROEL_DATA")
    with progress_bar() as progress:
        document, text = benchmarks.bench_poses(
            Path(options.out),
            rooms=tuple(options.scenes),
            seed_count=options.draws,
            data=Path(data) if data else None,
            kept=Path(options.rooms),
            progress=progress,
        )
    print_result(document, text.rstrip("\n"), as_json=options.json)
