"""`roel bench mapping`."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from roel_client.cli.output import print_result, progress_bar
from roel_client.cli.parser import Command, Subparsers, command, command_group, one_of
from roel_client.cli.staging import Staged

SUITES = ("quick", "presets", "ablation", "noise", "front-end", "peers", "curves", "full")


def add_commands(subparsers: Subparsers) -> None:
    """Declare `bench mapping`."""
    group = command_group(subparsers, "bench", "measure how good the results are")
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
    from roel_client import local

    out = Path(options.out)
    data = options.data or os.environ.get("ROEL_DATA")
    with progress_bar() as progress:
        document, text = local.bench_mapping(
            out,
            suite=options.suite,
            scenes=tuple(options.scenes) if options.scenes else None,
            methods=tuple(options.variants) if options.variants else None,
            data=Path(data) if data else None,
            rooms=Path(options.rooms) if options.rooms else out / "rooms",
            progress=progress,
        )
    print_result(document, text.rstrip("\n"), as_json=options.json)
