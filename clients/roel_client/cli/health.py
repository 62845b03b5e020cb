"""`roel health`."""

from __future__ import annotations

import argparse

from roel_client.cli.output import print_text
from roel_client.cli.parser import Command, Subparsers, command
from roel_client.cli.servers import add_server_options, server_options
from roel_client.cli.staging import Staged
from roel_service.errors import UnavailableError

DEADLINE_S = 3.0


def add_commands(subparsers: Subparsers) -> None:
    """Declare `health`."""
    parser = command(subparsers, "health", "ask a server whether it serves", Command(run=ask))
    add_server_options(parser, required=True, what="the server to ask")


def ask(options: argparse.Namespace, staged: Staged) -> None:
    """Print `SERVING`, or raise `UnavailableError`."""
    from roel_client.health import check_health

    status = check_health(options.server, DEADLINE_S, **server_options(options))
    if status != "SERVING":
        raise UnavailableError(options.server, "SERVING", status)
    print_text(status)
