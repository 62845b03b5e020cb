"""`roel admin`: care of a server's data folder."""

from __future__ import annotations

from roel_client.cli import data_folder, tokens
from roel_client.cli.parser import Subparsers, command_group


def add_commands(subparsers: Subparsers) -> None:
    """Declare the commands below `admin`."""
    group = command_group(subparsers, "admin", "care for the data folder of a server")
    data_folder.add_commands(group)
    tokens.add_commands(group)
