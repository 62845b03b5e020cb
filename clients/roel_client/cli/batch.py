"""`roel batch localize`."""

from __future__ import annotations

import argparse
from typing import Any

from roel_client.cli.configuration import effective_config
from roel_client.cli.output import print_result, progress_bar
from roel_client.cli.parser import (
    Command,
    Subparsers,
    command,
    command_group,
    integer,
    suffixed,
)
from roel_client.cli.process import interruptible
from roel_client.cli.servers import add_server_options, server_options
from roel_client.cli.staging import Staged

MAX_WORKER_COUNT = 64


def add_commands(subparsers: Subparsers) -> None:
    """Declare the commands below `batch`."""
    group = command_group(subparsers, "batch", "many questions at once")
    # The table is no staged output: beside it lies what an interrupted run found, for the next one.
    what = Command(run=localize, inputs=("manifest", "maps", "config"))
    parser = command(group, "localize", "find where many panoramas were taken", what)
    parser.add_argument(
        "manifest",
        metavar="MANIFEST",
        help='a line each: a path, or {"panorama": path, "prior": 4x4 rows}',
    )
    parser.add_argument(
        "--maps", required=True, nargs="+", metavar="MAP", help="1 to 8 .rlm files to look in"
    )
    parser.add_argument(
        "--out",
        required=True,
        type=suffixed(".parquet", ".jsonl"),
        metavar="FILE",
        help="a row for each query; FILE.partial keeps what an interrupted run found",
    )
    parser.add_argument("--config", metavar="FILE.toml", help="parameters that differ")
    parser.add_argument(
        "--workers",
        type=integer(1, MAX_WORKER_COUNT),
        metavar="N",
        help="queries at a time; default: one a core",
    )
    add_server_options(parser, required=False, what="let this server locate the panoramas")
    parser.add_argument("--json", action="store_true", help="print the counts as JSON")
    parser.set_defaults(preset="default")


def localize(options: argparse.Namespace, staged: Staged) -> None:
    """Locate the panoramas of a manifest, and print how many were found."""
    from roel_client.local import batches

    server = None
    if options.server is not None:
        server = (options.server, server_options(options))
    # A signal must reach the children, and the server that hosts the maps.
    with interruptible(), progress_bar() as progress:
        counts = batches.localize_batch(
            options.manifest,
            options.maps,
            options.out,
            config=effective_config(options).localize,
            worker_count=options.workers,
            server=server,
            progress=progress,
        )
    print_result(counts, told(counts), as_json=options.json)


def told(counts: dict[str, Any]) -> str:
    """The counts for people."""
    return (
        f"{counts['query_count']} panoramas: {counts['found_count']} found, "
        f"{counts['ambiguous_count']} ambiguous, {counts['not_found_count']} not found, "
        f"{counts['failed_count']} failed; {counts['known_count']} were known"
    )
