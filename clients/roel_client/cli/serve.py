"""`roel serve`."""

from __future__ import annotations

import argparse
from pathlib import Path

from roel_client.cli.output import print_text, to_json
from roel_client.cli.parser import Command, Subparsers, command, integer
from roel_client.cli.staging import Staged


def add_commands(subparsers: Subparsers) -> None:
    """Declare `serve`."""
    parser = command(
        subparsers, "serve", "serve maps over gRPC", Command(run=serve, in_child=False)
    )
    parser.add_argument("--data", required=True, metavar="DIR", help="all that the server keeps")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (127.0.0.1)")
    parser.add_argument(
        "--port",
        type=integer(0, 65535),
        default=50051,
        metavar="N",
        help="port to listen on (50051); 0 takes a free one",
    )
    parser.add_argument(
        "--insecure",
        action="store_true",
        help="allow a host other than loopback, though calls are not encrypted",
    )


def serve(options: argparse.Namespace, staged: Staged) -> None:
    """Serve until SIGINT or SIGTERM; one JSON line on stdout says when and where."""
    from roel_client import local

    local.serve(
        Path(options.data),
        options.host,
        options.port,
        insecure=options.insecure,
        on_ready=lambda address: print_text(to_json({"address": address})),
    )
