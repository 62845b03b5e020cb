"""The inside of a child: it runs the tasks that arrive and says how they go."""

from __future__ import annotations

import multiprocessing
import os
import pkgutil
import signal
import threading
import time
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection, wait
from typing import Any

from roel_service.errors import LimitError, RoelError
from roel_service.jobs import memory
from roel_service.jobs.faults import fingerprint_of
from roel_service.jobs.task import Done, Failed, Limits, Message, Partial, Ready, TaskSpec, Tell
from roel_service.progress import Progress

# A stage that just began is told at once; within a stage this often is enough for a reader.
PROGRESS_INTERVAL_S = 0.25

# The work has threads of its own; libraries that start more only get into each other's way.
LIBRARY_THREADS = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
)

# A child takes what the front leaves.
NICENESS = 10

Work = Callable[[Any, Tell], Any]


def serve(pipe: Connection, preload: str) -> None:
    """Body of a child: run each task that arrives, until nobody can send any more.

    Args:
        pipe: tasks come in, messages go out; closed by the front.
        preload: entry point that the tasks will name, made ready before the first of them; or nothing.
    """
    # Ctrl-C reaches the whole process group; the front alone decides what it means. SIGTERM keeps
    # its default action, because a Python handler would wait for native code to return.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _end_with_parent()
    # The front answers health checks while every core builds.
    os.nice(NICENESS)
    os.environ.update(dict.fromkeys(LIBRARY_THREADS, "1"))
    memory.volunteer()
    workshop = Workshop()
    if preload:
        workshop.work(preload)
    pipe.send(Ready())
    while (spec := received(pipe)) is not None:
        with memory.reserving_at_most(spec.limits.memory_bytes):
            message = last_message(spec, thinned(pipe.send), workshop)
        pipe.send(message)


class Workshop:
    """Who does the work that tasks name.

    An entry point is a function, or a class: of that one object is made, which may keep between tasks
    what it likes.
    """

    def __init__(self) -> None:
        self._made: dict[str, Work] = {}

    def work(self, entrypoint: str) -> Work:
        """The function, or the object."""
        found = pkgutil.resolve_name(entrypoint)
        if not isinstance(found, type):
            return found  # type: ignore[no-any-return]
        if entrypoint not in self._made:
            self._made[entrypoint] = found()
        return self._made[entrypoint]


def received(pipe: Connection) -> Any:
    """What comes next; None when the other end is gone."""
    try:
        return pipe.recv()
    except (EOFError, OSError):
        return None


def last_message(spec: TaskSpec, tell: Tell, workshop: Workshop) -> Message:
    """Run the work to its end, whatever that is."""
    try:
        return Done(result=workshop.work(spec.entrypoint)(spec.parameters, tell))
    except RoelError as error:
        return error
    except MemoryError:
        return out_of_memory(spec.limits, "a larger allocation")
    except Exception as error:  # the border of the work: whatever is left is a bug
        return Failed(fingerprint=fingerprint_of(error), traceback=traceback.format_exc())


def out_of_memory(limits: Limits, found: str) -> LimitError:
    """The error for work that needs more memory than it may have."""
    expected = f"at most {limits.memory_bytes // 2**20} MiB of memory"
    return LimitError("task", expected, found, reason="TASK_OUT_OF_MEMORY")


def thinned(send: Callable[[Message], None]) -> Tell:
    """Pass on what is worth telling: every stage, and within a stage now and then."""
    stage, next_s = "", 0.0

    def tell(news: Progress | Partial) -> None:
        nonlocal stage, next_s
        if isinstance(news, Progress):
            now_s = time.monotonic()
            if news.stage == stage and now_s < next_s:
                return
            stage, next_s = news.stage, now_s + PROGRESS_INTERVAL_S
        send(news)

    return tell


def _end_with_parent() -> None:
    """A front that was killed must not leave children behind."""
    parent = multiprocessing.parent_process()
    if parent is None:
        raise RuntimeError("this is the body of a child process")

    def watch() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
