"""`roel config show`."""

from __future__ import annotations

import argparse
from pathlib import Path

from roel_client.cli.output import print_text
from roel_client.cli.parser import (
    Command,
    Parser,
    Subparsers,
    command,
    command_group,
    integer,
    one_of,
)
from roel_client.cli.staging import Staged
from roel_service.config.load import Tables, load_config, to_toml
from roel_service.config.presets import PRESETS
from roel_service.config.stages import Config
from roel_service.naming import naming


def add_commands(subparsers: Subparsers) -> None:
    """Declare `config show`."""
    group = command_group(subparsers, "config", "look at parameters")
    show = Command(run=show_config, inputs=("config",))
    parser = command(group, "show", "print every effective parameter as TOML", show)
    add_config_options(parser)


def add_seed_option(parser: Parser) -> None:
    """`--seed`."""
    parser.add_argument("--seed", type=integer(0), metavar="N", help="fixes all randomness (0)")


def add_config_options(parser: Parser) -> None:
    """The options that choose parameters."""
    parser.add_argument(
        "--preset",
        default="default",
        type=one_of(*PRESETS),
        metavar="NAME",
        help="whole set of parameters: default, or paper for the published one",
    )
    parser.add_argument("--config", metavar="FILE.toml", help="parameters that differ from it")


def seed_table(options: argparse.Namespace) -> Tables:
    """What `--seed` changes of the configuration."""
    return {} if options.seed is None else {"runtime": {"seed": options.seed}}


def effective_config(options: argparse.Namespace, overrides: Tables | None = None) -> Config:
    """The preset, changed by `--config`, changed by `overrides` of other options."""
    if options.config is None:
        return load_config(options.preset, None, overrides)
    path = Path(options.config)
    with naming({path.name: options.config}):
        return load_config(options.preset, path, overrides)


def show_config(options: argparse.Namespace, staged: Staged) -> None:
    """Print the effective TOML; it is itself a valid `--config`."""
    print_text(to_toml(effective_config(options)).rstrip("\n"))
