"""What a command says: results on stdout; logs, progress and one line of failure on stderr."""

from __future__ import annotations

import json
import logging
import logging.handlers
import math
import platform
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from roel_service import __version__
from roel_service.progress import Progress, ProgressCallback, ignore

LOGGER = logging.getLogger(__name__)


def print_result(document: dict[str, Any], text: str, *, as_json: bool) -> None:
    """The result of a command, as one JSON document on one line or as text for people."""
    print_text(to_json(document) if as_json else text)


def print_text(text: str) -> None:
    """Lines on stdout."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def to_json(document: dict[str, Any]) -> str:
    """JSON on one line; NaN and infinity become null."""
    return json.dumps(_finite(document), ensure_ascii=False, allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def say(line: str) -> None:
    """One line on stderr."""
    sys.stderr.write(" ".join(line.split()) + "\n")
    sys.stderr.flush()


class LogHandler(logging.handlers.MemoryHandler):
    """Writes to stderr: at once, or kept until the command succeeds.

    A command that fails says so in exactly one line; warnings must not stand before it.
    """

    def __init__(self, *, at_once: bool) -> None:
        stream = logging.StreamHandler(sys.stderr)
        stream.setFormatter(logging.Formatter("roel: %(levelname)s: %(message)s"))
        super().__init__(sys.maxsize, flushLevel=sys.maxsize, target=stream, flushOnClose=False)
        self._at_once = at_once

    def shouldFlush(self, record: logging.LogRecord) -> bool:
        return self._at_once


@contextmanager
def logging_to_stderr(level: str, *, at_once: bool = False) -> Iterator[LogHandler]:
    """Send the log of every library to stderr, from this level on; details come at once."""
    handler = LogHandler(at_once=at_once or level in ("debug", "info"))
    root = logging.getLogger()
    previous = root.level
    root.addHandler(handler)
    root.setLevel(level.upper())
    logging.captureWarnings(True)
    try:
        yield handler
    finally:
        logging.captureWarnings(False)
        root.setLevel(previous)
        root.removeHandler(handler)


@contextmanager
def progress_bar() -> Iterator[ProgressCallback]:
    """A callback that draws the share done on stderr if that is a terminal."""
    if not sys.stderr.isatty():
        yield ignore
        return
    from tqdm import tqdm

    bar_format = "{desc:<14}|{bar}| {percentage:3.0f} % {elapsed}"
    with tqdm(total=1.0, leave=False, miniters=0, bar_format=bar_format, file=sys.stderr) as bar:

        def show(progress: Progress) -> None:
            bar.update(progress.fraction - bar.n)
            if bar.desc != progress.stage:
                bar.set_description_str(progress.stage)

        yield show


def write_crash_report(command_line: list[str], what: str) -> str:
    """Path of a new file that says what happened, for whoever mends the bug."""
    with tempfile.NamedTemporaryFile(
        "w", prefix="roel-crash-", suffix=".txt", delete=False, encoding="utf-8"
    ) as report:
        report.write(f"command: {command_line}\n")
        report.write(f"versions: roel {__version__}, Python {platform.python_version()}\n")
        report.write(f"system: {platform.platform()}\n\n{what}\n")
    return report.name
