"""Entry of the console script: parse, check the named files, run, answer with an exit code."""

from __future__ import annotations

import argparse
import errno
import logging
import os
import signal
import sys
import traceback
from collections.abc import Callable, Sequence

from roel_client.cli import (
    admin,
    batch,
    bench,
    configuration,
    demo,
    evaluate,
    health,
    localize,
    maps,
    poses,
    register,
    serve,
    simulate,
    track,
)
from roel_client.cli.output import (
    LogHandler,
    logging_to_stderr,
    print_result,
    say,
    write_crash_report,
)
from roel_client.cli.parser import LOG_LEVELS, Command, Parser, UsageError
from roel_client.cli.process import Interrupted, ignore_signals, interruptible, run_in_child
from roel_client.cli.staging import NamedFiles, publish, staging
from roel_service import __version__
from roel_service.errors import Cancelled, NoAnswerError, RoelError
from roel_service.wire.names import is_resource_name

DONE, BUG, UNUSABLE, NO_ANSWER = 0, 1, 2, 3

# Faults of the place that outputs go to, met while writing; everything else is checked before.
WRITE_FAULTS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command line and return its exit code."""
    command_line = list(sys.argv[1:] if arguments is None else arguments)
    try:
        with interruptible():
            return answer(lambda: run(command_line), command_line)
    except Interrupted as interrupted:
        return interrupted.exit_code


def run(command_line: list[str]) -> int:
    """Parse the command line and run its command, in a child unless it handles signals itself."""
    options = parser().parse_args(command_line)
    command: Command = options.command
    # gRPC's core writes to stderr by itself, beside the one line of a failure.
    os.environ.setdefault("GRPC_VERBOSITY", "NONE")
    with logging_to_stderr(log_level(options), at_once=not command.in_child) as log:
        if command.in_child:
            return run_staged(command, options, log, command_line)
        command.run(options, {})
        return DONE


def run_staged(
    command: Command, options: argparse.Namespace, log: LogHandler, command_line: list[str]
) -> int:
    """Run a command in a child, and move its outputs to their places when it is done."""
    files = named_files(command, options)
    files.check()
    with staging(files) as staged:

        def work() -> int:
            # It has threads of its own; those of linear algebra are busy with waiting for one another.
            os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
            command.run(options, staged)
            log.flush()
            return DONE

        code = run_in_child(
            lambda: answer(work, command_line, as_json=getattr(options, "json", False))
        )
        ignore_signals()
        if code == DONE:
            publish(files, staged)
    return code if code >= 0 else ended_by_signal(-code, command_line)


def answer(work: Callable[[], int], command_line: list[str], *, as_json: bool = False) -> int:
    """Exit code of `work`; what it raises becomes one line on stderr and the code for it.

    With `as_json` the result that comes with the lack of an answer goes to stdout.
    """
    try:
        return work()
    except NoAnswerError as error:
        if as_json and error.result is not None:
            print_result(error.result, "", as_json=True)
        say(f"roel: no answer: {error}")
        return NO_ANSWER
    except RoelError as error:
        if type(error) is RoelError:
            # A server's fault: its log has the details.
            return bug(str(error), command_line)
        say(f"roel: error: {error}")
        return UNUSABLE
    except Cancelled:
        return 128 + signal.SIGINT
    except BrokenPipeError:
        # Nobody reads stdout any more, as in `roel map info ... | head -0`.
        return 128 + signal.SIGPIPE
    except Exception as error:  # the border of the process: whatever is left is a bug
        if isinstance(error, OSError) and error.errno in WRITE_FAULTS:
            place = error.filename or "output"
            say(f"roel: error: {place}: expected a place to write to, found {error.strerror}")
            return UNUSABLE
        return bug("".join(traceback.format_exception(error)), command_line)


def bug(what: str, command_line: list[str]) -> int:
    """Report a fault of this program."""
    if logging.getLogger().isEnabledFor(logging.DEBUG):
        sys.stderr.write(what)
    say(f"roel: internal error: crash report in {write_crash_report(command_line, what)}")
    return BUG


def ended_by_signal(number: int, command_line: list[str]) -> int:
    """Exit code for a child that a signal ended which did not come through this process."""
    if number in (signal.SIGINT, signal.SIGTERM):
        return 128 + number
    return bug(f"the worker was ended by {signal.Signals(number).name}", command_line)


def parser() -> Parser:
    """The whole command line; building it imports no algorithm."""
    top = Parser(prog="roel", description="3D line maps from event cameras.")
    top.add_argument("--version", action="version", version=f"roel {__version__}")
    subparsers = top.add_subparsers(required=True, metavar="COMMAND")
    for group in (
        maps,
        register,
        localize,
        batch,
        poses,
        track,
        evaluate,
        simulate,
        bench,
        configuration,
        serve,
        health,
        admin,
        demo,
    ):
        group.add_commands(subparsers)
    return top


def log_level(options: argparse.Namespace) -> str:
    """The level asked for by option or environment."""
    level = options.log_level or os.environ.get("ROEL_LOG_LEVEL") or "warning"
    if level not in LOG_LEVELS:
        raise UsageError("ROEL_LOG_LEVEL", f"one of {', '.join(LOG_LEVELS)}", repr(level))
    return str(level)


def named_files(command: Command, options: argparse.Namespace) -> NamedFiles:
    """The files and folders that the user named."""
    has_server = getattr(options, "server", None) is not None

    def given(names: tuple[str, ...]) -> dict[str, str]:
        found = {}
        for name in names:
            value = getattr(options, name)
            for index, item in enumerate(value if isinstance(value, list) else [value]):
                if item is not None and not (has_server and is_resource_name(item)):
                    found[f"{name}[{index}]" if index else name] = item
        return found

    return NamedFiles(
        inputs=given(command.inputs),
        outputs=given(command.outputs),
        folders=given(command.folders),
        scratch=command.scratch,
    )
