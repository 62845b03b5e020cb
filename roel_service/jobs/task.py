"""What a child runs, and what it says while it runs."""

from __future__ import annotations

import multiprocessing
import os
import pkgutil
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any

from roel_service.errors import RoelError
from roel_service.progress import Progress, ProgressCallback

# A stage that just began is told at once; within a stage this often is enough for a reader.
PROGRESS_INTERVAL_S = 0.25


@dataclass(frozen=True, kw_only=True)
class TaskSpec:
    """Work for a child.

    Attributes:
        entrypoint: `module:function`, imported in the child alone; it is called with the
            parameters and a progress callback.
        parameters: anything that can be pickled; inputs are named by files that never change.
    """

    entrypoint: str
    parameters: Any


@dataclass(frozen=True, kw_only=True)
class Done:
    """The last message of a child that succeeded."""

    result: Any


# A child sends progress, then at most one of the others.
Message = Progress | Done | RoelError


def run_task(spec: TaskSpec, pipe: Connection) -> None:
    """Body of a child: run the work, tell its outcome.

    Any exception but a `RoelError` is a bug: the interpreter prints it and exits with code 1.
    """
    # Ctrl-C reaches the whole process group; the front alone decides what it means. SIGTERM keeps
    # its default action, because a Python handler would wait for native code to return.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _end_with_parent()
    work: Callable[[Any, ProgressCallback], Any] = pkgutil.resolve_name(spec.entrypoint)
    try:
        pipe.send(Done(result=work(spec.parameters, _Reporter(pipe))))
    except RoelError as error:
        pipe.send(error)


class _Reporter:
    """Progress callback that sends what is worth sending."""

    def __init__(self, pipe: Connection) -> None:
        self._pipe = pipe
        self._stage = ""
        self._next_s = 0.0

    def __call__(self, progress: Progress) -> None:
        now_s = time.monotonic()
        if progress.stage == self._stage and now_s < self._next_s:
            return
        self._stage = progress.stage
        self._next_s = now_s + PROGRESS_INTERVAL_S
        self._pipe.send(progress)


def _end_with_parent() -> None:
    """A front that was killed must not leave children behind."""
    parent = multiprocessing.parent_process()
    if parent is None:
        raise RuntimeError("run_task is the body of a child process")

    def watch() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
