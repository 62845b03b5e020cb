"""One child process for the work, and what its parent does about signals."""

from __future__ import annotations

import math
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import NoReturn

ENDING_SIGNALS = (signal.SIGINT, signal.SIGTERM)

# A child that cancels work on a server gets this long before it is killed; the contract gives 2 s
# for everything.
GRACE_S = 1.5
POLL_INTERVAL_S = 0.01


class Interrupted(BaseException):
    """SIGINT or SIGTERM arrived; not an `Exception`, so that nothing but `main` handles it."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.exit_code = 128 + number


SignalHandler = Callable[[int, FrameType | None], object]


@contextmanager
def interruptible() -> Iterator[None]:
    """The first SIGINT or SIGTERM raises `Interrupted`; later ones wait until all is cleaned up."""

    def interrupt(number: int, frame: FrameType | None) -> NoReturn:
        ignore_signals()
        raise Interrupted(number)

    with signals_handled(interrupt):
        yield


@contextmanager
def signals_handled(handler: SignalHandler) -> Iterator[None]:
    """SIGINT and SIGTERM go to this handler."""
    previous = {number: signal.signal(number, handler) for number in ENDING_SIGNALS}
    try:
        yield
    finally:
        for number, old in previous.items():
            signal.signal(number, old)


def ignore_signals() -> None:
    """From here on the command finishes what it does."""
    for number in ENDING_SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def run_in_child(work: Callable[[], int]) -> int:
    """Exit code of `work`, run in a fork of this process; negative if a signal ended it.

    A child can be stopped while native code runs, where a Python handler would wait for its end.
    Nothing heavy and no thread exists yet at the fork, so it is cheap and safe.

    Raises:
        Interrupted: after the child has ended.
    """
    # A handler that raises in the middle of the fork would be lost there, so signals are only noted.
    noted: list[int] = []
    child = 0
    try:
        with signals_handled(lambda number, frame: noted.append(number)):
            child = os.fork()
            if child == 0:
                _become(work, noted)
        if noted:
            signal.raise_signal(noted[0])
        return _exit_code(child)
    except Interrupted:
        if child:
            _stop(child)
        raise


def _become(work: Callable[[], int], noted: list[int]) -> NoReturn:
    """Be the child: default signal actions, and never return into the parent's frames."""
    code = 1
    try:
        for number in ENDING_SIGNALS:
            signal.signal(number, signal.SIG_DFL)
        if noted:
            signal.raise_signal(noted[0])
        code = work()
    finally:
        os._exit(code)


def _exit_code(child: int, until_s: float = math.inf) -> int:
    """Wait for the child's end, at most until a time of `time.monotonic`.

    It is asked again and again: a signal that arrives just before a blocking wait begins would be
    noticed only after it.

    Raises:
        TimeoutError: it has not ended by then.
    """
    while time.monotonic() < until_s:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        time.sleep(POLL_INTERVAL_S)
    raise TimeoutError


def _stop(child: int) -> None:
    """End the child: politely, then for certain; it may have ended by itself just now."""
    with suppress(ProcessLookupError, ChildProcessError):
        os.kill(child, signal.SIGTERM)
        try:
            _exit_code(child, time.monotonic() + GRACE_S)
        except TimeoutError:
            os.kill(child, signal.SIGKILL)
            _exit_code(child)
