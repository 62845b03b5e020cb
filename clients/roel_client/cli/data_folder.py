"""`roel admin fsck`, `roel admin backup`, `roel admin gc`."""

from __future__ import annotations

import argparse

from roel_client.cli.output import print_result
from roel_client.cli.parser import Command, Parser, Subparsers, command
from roel_client.cli.staging import Staged


def add_commands(group: Subparsers) -> None:
    """Declare the commands."""
    fsck = command(group, "fsck", "recompute every digest, check every row", Command(run=check))
    _add_options(fsck)
    backup = Command(run=back_up, folders=("out",))
    copy = command(group, "backup", "copy a data folder, also while it is served", backup)
    _add_options(copy)
    copy.add_argument("--out", required=True, metavar="DIR", help="a new or empty folder")
    sweep = command(
        group,
        "gc",
        "delete what has expired, and files that nothing names; a server does so by itself",
        Command(run=collect_garbage),
    )
    _add_options(sweep)


def _add_options(parser: Parser) -> None:
    parser.add_argument("--data", required=True, metavar="DIR", help="the data folder")
    parser.add_argument("--json", action="store_true", help="print as JSON")


def check(options: argparse.Namespace, staged: Staged) -> None:
    """Say whether a data folder is sound."""
    from roel_client.local import data_folder

    findings = data_folder.check_data(options.data)
    print_result(findings, f"{options.data}: sound; {_size(findings)}", as_json=options.json)


def back_up(options: argparse.Namespace, staged: Staged) -> None:
    """Copy a data folder, and check the copy."""
    from roel_client.local import data_folder

    findings = data_folder.back_up_data(options.data, staged["out"])
    print_result(findings, f"{options.out}: {_size(findings)}", as_json=options.json)


def collect_garbage(options: argparse.Namespace, staged: Staged) -> None:
    """Delete what nobody needs any more."""
    from roel_client.local import data_folder

    swept = data_folder.collect_garbage(options.data)
    text = (
        f"{options.data}: deleted {swept['deleted_blob_count']} files of"
        f" {swept['deleted_bytes']} bytes, kept {swept['kept_blob_count']}"
    )
    print_result(swept, text, as_json=options.json)


def _size(findings: dict[str, object]) -> str:
    return (
        f"{findings['event_stream_count']} recordings, {findings['map_version_count']} map versions,"
        f" {findings['operation_count']} operations, {findings['blob_bytes']} bytes"
        f" in {findings['blob_count']} files"
    )
