"""`roel admin token`: who may call a server."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from roel_client.cli.output import print_result
from roel_client.cli.parser import Command, Subparsers, command, command_group, integer, one_of
from roel_client.cli.staging import Staged

GIB = 2**30
ROLES = ("localize_only", "reader", "builder", "admin")


def add_commands(subparsers: Subparsers) -> None:
    """Declare the commands below `token`."""
    group = command_group(subparsers, "token", "make, list and revoke tokens of a server's callers")
    _add_create(group)
    _add_list(group)
    _add_revoke(group)


def _add_create(group: Subparsers) -> None:
    create = _token_command(group, "create", "name a caller and print its token, once", make_token)
    create.add_argument("name", metavar="NAME", help="shown in logs; the name in a certificate")
    create.add_argument(
        "--role", required=True, type=one_of(*ROLES), metavar="ROLE", help=", ".join(ROLES)
    )
    create.add_argument(
        "--days", type=integer(1, 36500), metavar="N", help="the token expires then (never)"
    )
    create.add_argument(
        "--max-gib", type=integer(1, 10**6), metavar="N", help="most recordings and blobs, in GiB"
    )
    create.add_argument(
        "--max-recordings", type=integer(1, 10**9), metavar="N", help="most recordings"
    )
    create.add_argument(
        "--max-operations", type=integer(1, 10**6), metavar="N", help="most builds at a time"
    )


def _add_list(group: Subparsers) -> None:
    _token_command(group, "list", "list the callers, without their tokens", list_tokens)


def _add_revoke(group: Subparsers) -> None:
    revoke = _token_command(group, "revoke", "let a caller in no longer", revoke_token)
    revoke.add_argument("name", metavar="NAME")


def _token_command(group: Subparsers, name: str, summary: str, run: Any) -> Any:
    parser = command(group, name, summary, Command(run=run))
    parser.add_argument("--data", required=True, metavar="DIR", help="all that the server keeps")
    parser.add_argument("--json", action="store_true", help="print as JSON")
    return parser


def make_token(options: argparse.Namespace, staged: Staged) -> None:
    """Print a new token."""
    from roel_client.local import data_folder

    quota = {
        "stored_bytes": options.max_gib and options.max_gib * GIB,
        "event_streams": options.max_recordings,
        "unfinished_operations": options.max_operations,
    }
    token = data_folder.create_token(
        Path(options.data), options.name, options.role, options.days, quota
    )
    told = {"name": options.name, "role": options.role, "token": token}
    print_result(told, token, as_json=options.json)


def list_tokens(options: argparse.Namespace, staged: Staged) -> None:
    """Print who may call."""
    from roel_client.local import data_folder

    callers = data_folder.list_tokens(Path(options.data))
    lines = [
        f"{item['name']:<24}{item['role']:<16}{item['expires'] or 'never':<28}{_limits(item['quota'])}"
        for item in callers
    ]
    print_result({"tokens": callers}, "\n".join(lines), as_json=options.json)


def _limits(quota: dict[str, int | None]) -> str:
    """What a caller may have, in words; nothing where nothing limits it."""
    told = {name: limit for name, limit in quota.items() if limit is not None}
    return ", ".join(f"{name.replace('_', ' ')} {limit}" for name, limit in told.items())


def revoke_token(options: argparse.Namespace, staged: Staged) -> None:
    """Make a caller nobody."""
    from roel_client.local import data_folder

    data_folder.revoke_token(Path(options.data), options.name)
    print_result(
        {"name": options.name}, f"{options.name} is let in no longer", as_json=options.json
    )
