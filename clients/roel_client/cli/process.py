"""One child process for the work, and what its parent does about signals."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn

ENDING_SIGNALS = (signal.SIGINT, signal.SIGTERM)

# A child that cancels work on a server gets this long before it is killed; the contract gives 2 s
# for everything.
GRACE_S = 1.5


class Interrupted(BaseException):
    """SIGINT or SIGTERM arrived; not an `Exception`, so that nothing but `main` handles it."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.exit_code = 128 + number


@contextmanager
def interruptible() -> Iterator[None]:
    """The first SIGINT or SIGTERM raises `Interrupted`; later ones wait until all is cleaned up."""

    def interrupt(number: int, frame: FrameType | None) -> NoReturn:
        ignore_signals()
        raise Interrupted(number)

    previous = {number: signal.signal(number, interrupt) for number in ENDING_SIGNALS}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


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
    # Held back around the fork: the child must not meet a signal with its parent's handlers.
    signal.pthread_sigmask(signal.SIG_BLOCK, ENDING_SIGNALS)
    child = os.fork()
    if child == 0:
        _become(work)
    try:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING_SIGNALS)
        _, status = os.waitpid(child, 0)
    except Interrupted:
        _stop(child)
        raise
    return os.waitstatus_to_exitcode(status)


def _become(work: Callable[[], int]) -> NoReturn:
    """Be the child: default signal actions, and never return into the parent's frames."""
    code = 1
    try:
        for number in ENDING_SIGNALS:
            signal.signal(number, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING_SIGNALS)
        code = work()
    finally:
        os._exit(code)


def _stop(child: int) -> None:
    """End the child: politely, then for certain."""
    os.kill(child, signal.SIGTERM)
    deadline = time.monotonic() + GRACE_S
    while time.monotonic() < deadline:
        ended, _ = os.waitpid(child, os.WNOHANG)
        if ended:
            return
        time.sleep(0.01)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
