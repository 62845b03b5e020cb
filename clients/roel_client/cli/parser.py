"""Options whose errors are one line of the form `NAME: expected WHAT, found WHAT`."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from roel_client.cli.staging import Staged
from roel_service import __version__
from roel_service.errors import InputError

LOG_LEVELS = ("debug", "info", "warning", "error")

# What argparse says, and the same as subject, expected, found; {prog} is the command.
ARGPARSE_MESSAGES = (
    (r"argument (\S+): expected ((?:at least )?one argument)", r"\1", r"\2", "none"),
    (r"argument (\S+): expected (.*), found (.*)", r"\1", r"\2", r"\3"),
    (r"argument \S+: invalid choice: (\S+) \(choose from (.*)\)", "{prog}", r"one of \2", r"\1"),
    (r"argument (\S+): (.*)", r"\1", "a use that --help shows", r"\2"),
    (r"the following arguments are required: (.*)", "{prog}", r"\1", "none"),
    (r"unrecognized arguments: (\S+)(.*)", r"\1", "an argument that --help shows", r"\1\2"),
    (r"(.*)", "{prog}", "a use that --help shows", r"\1"),
)


class UsageError(InputError):
    """A command line that does not say what to do."""


class Parser(argparse.ArgumentParser):
    """An argument parser that raises `UsageError` instead of printing its usage and leaving."""

    def __init__(self, **options: Any) -> None:
        super().__init__(allow_abbrev=False, **options)

    def error(self, message: str) -> NoReturn:
        for pattern, *parts in ARGPARSE_MESSAGES:
            match = re.fullmatch(pattern, message, re.DOTALL)
            if match:
                subject, expected, found = (match.expand(part) for part in parts)
                raise UsageError(subject.format(prog=self.prog), expected, found)
        raise AssertionError("the last pattern matches everything")


@dataclass(frozen=True, kw_only=True)
class Command:
    """What `main` must know about a command before it runs.

    Attributes:
        run: the work, called in the child with the parsed options and where to write outputs.
        inputs: options (or positionals) that name input files.
        outputs: options that name files to write.
        folders: options that name folders to create.
        scratch: whether it needs a folder that goes when the command ends.
        in_child: False for a server, which handles signals itself.
    """

    run: Callable[[argparse.Namespace, Staged], None]
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    folders: tuple[str, ...] = ()
    scratch: bool = False
    in_child: bool = True


Subparsers = Any  # argparse names the class only privately


def command_group(subparsers: Subparsers, name: str, summary: str) -> Subparsers:
    """A word that only groups commands, such as `map`."""
    group = subparsers.add_parser(name, help=summary, description=summary)
    group.add_argument("--version", action="version", version=f"roel {__version__}")
    return group.add_subparsers(required=True, metavar="COMMAND")


def command(subparsers: Subparsers, name: str, summary: str, what: Command) -> Parser:
    """A command, with the options that every command has."""
    parser: Parser = subparsers.add_parser(name, help=summary, description=summary)
    parser.add_argument("--version", action="version", version=f"roel {__version__}")
    parser.add_argument(
        "--log-level",
        metavar="LEVEL",
        type=one_of(*LOG_LEVELS),
        help="debug, info, warning (default) or error; ROEL_LOG_LEVEL does the same",
    )
    parser.set_defaults(command=what)
    return parser


def one_of(*names: str) -> Callable[[str], str]:
    """The value is one of these words."""

    def parse(text: str) -> str:
        if text not in names:
            raise _mismatch(f"one of {', '.join(names)}", text)
        return text

    return parse


def integer(minimum: int, maximum: int | None = None) -> Callable[[str], int]:
    """The value is a whole number in a range."""
    expected = f"an integer of at least {minimum}"
    if maximum is not None:
        expected += f" and at most {maximum}"

    def parse(text: str) -> int:
        if not re.fullmatch(r"[+-]?[0-9]{1,18}", text):
            raise _mismatch(expected, text)
        value = int(text)
        if value < minimum or (maximum is not None and value > maximum):
            raise _mismatch(expected, text)
        return value

    return parse


def between(low: float, high: float) -> Callable[[str], float]:
    """The value is a number in a range, both ends included."""

    def parse(text: str) -> float:
        expected = f"a number between {low:g} and {high:g}"
        try:
            value = float(text)
        except ValueError:
            raise _mismatch(expected, text) from None
        if not (math.isfinite(value) and low <= value <= high):
            raise _mismatch(expected, text)
        return value

    return parse


def size(text: str) -> tuple[int, int]:
    """Width and height in pixels, written WxH."""
    match = re.fullmatch(r"([1-9][0-9]{0,4})x([1-9][0-9]{0,4})", text)
    if match is None:
        raise _mismatch("a size such as 240x180", text)
    return int(match[1]), int(match[2])


def address(text: str) -> str:
    """A server's address, written HOST:PORT."""
    match = re.fullmatch(r"(\S+):([0-9]{1,5})", text)
    if match is None or not 0 < int(match[2]) < 65536:
        raise _mismatch("HOST:PORT", text)
    return text


def endpoint(text: str) -> tuple[str, int]:
    """Where to listen, written HOST:PORT; port 0 is any."""
    match = re.fullmatch(r"\[?([^\s\[\]]+)\]?:([0-9]{1,5})", text)
    if match is None or not int(match[2]) < 65536:
        raise _mismatch("HOST:PORT", text)
    return match[1], int(match[2])


def suffixed(*suffixes: str) -> Callable[[str], str]:
    """A file name that ends in one of these."""

    def parse(text: str) -> str:
        if Path(text).suffix.lower() not in suffixes:
            raise _mismatch(f"a file name that ends in {', '.join(suffixes)}", text)
        return text

    return parse


def _mismatch(expected: str, found: str) -> argparse.ArgumentTypeError:
    return argparse.ArgumentTypeError(f"expected {expected}, found {found!r}")
