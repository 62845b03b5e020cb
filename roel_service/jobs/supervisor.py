"""Child processes: start, listen, watch their limits, end."""

from __future__ import annotations

import asyncio
import multiprocessing
import signal
import threading
from collections.abc import Awaitable, Callable
from multiprocessing.connection import Connection
from typing import Any

from roel_service.errors import LimitError, RoelError, UnavailableError
from roel_service.jobs import memory, worker
from roel_service.jobs.faults import logged_failure
from roel_service.jobs.task import (
    Done,
    Failed,
    Limits,
    Message,
    OnNews,
    Partial,
    Ready,
    TaskSpec,
    Usage,
)
from roel_service.progress import Progress

# How long a child may take to end after SIGTERM.
TERMINATION_GRACE_S = 0.5
# How often limits are looked at: a child that fills memory at 2 GiB/s gains 100 MiB in between.
WATCH_INTERVAL_S = 0.05
USAGE_INTERVAL_S = 1.0

# Signals of a process that broke by itself; any other came from outside.
CRASHES = {signal.SIGSEGV, signal.SIGABRT, signal.SIGBUS, signal.SIGFPE, signal.SIGILL}

# A child that was killed this close to its limit was killed for it.
NEAR_LIMIT_SHARE = 0.9

# A fresh interpreter: it starts at once whatever the front holds, and shares no thread or lock.
_CONTEXT = multiprocessing.get_context("spawn")


class Child:
    """One process, and a thread that listens to it.

    Args:
        preload: entry point that its tasks will name; it is ready before the first one arrives.
    """

    def __init__(self, preload: str = "") -> None:
        self._messages: asyncio.Queue[Message | None] = asyncio.Queue()
        self._ready = asyncio.Event()
        self._ended = asyncio.Event()
        self._pipe, child_end = _CONTEXT.Pipe()
        self._process = _CONTEXT.Process(target=worker.serve, args=(child_end, preload))
        self._process.start()
        child_end.close()
        self._kernel_kill_count = memory.kernel_kill_count()
        self._peak_bytes = 0
        self._is_sound = True
        loop = asyncio.get_running_loop()
        threading.Thread(target=self._listen, args=(loop,), daemon=True).start()

    @property
    def is_reusable(self) -> bool:
        """Whether the child lives and has no task."""
        return self._is_sound and self._messages.empty()

    @property
    def resident_bytes(self) -> int:
        """Memory that the process has touched; 0 if it cannot be known."""
        return memory.resident_bytes(self._process.pid or 0)

    async def run(self, spec: TaskSpec, on_news: OnNews) -> Any:
        """Result of one task; afterwards `is_reusable` says whether the child can take another.

        Raises:
            RoelError: what the work raised.
            FaultError: it raised anything else, or crashed.
            LimitError: TASK_OUT_OF_MEMORY, TASK_TIME_LIMIT.
            UnavailableError: WORKER_LOST, the child was killed.
        """
        # What it loads before its first task, or compiles on a new machine, is in no caller's time.
        await self._ready.wait()
        self._is_sound = False
        self._peak_bytes = 0
        # A child that is gone is noticed by the thread that listens.
        await asyncio.to_thread(_send, self._pipe, spec)
        watch = asyncio.create_task(self._watch(spec.limits))
        try:
            message = await last_message(self._messages.get, on_news)
        finally:
            watch.cancel()
        if message is None:
            raise self._lost(spec)
        self._is_sound = not isinstance(message, Failed | LimitError)
        return result_of(message, spec)

    async def end(self) -> None:
        """Be sure that the child is gone: politely, then for certain."""
        self._process.terminate()
        try:
            await asyncio.wait_for(self._ended.wait(), TERMINATION_GRACE_S)
        except TimeoutError:
            self._process.kill()
            await self._ended.wait()

    async def _watch(self, limits: Limits) -> None:
        """Tell what the child uses; end it when that is too much."""
        pid = self._process.pid or 0
        loop = asyncio.get_running_loop()
        began_s = told_s = loop.time()
        while True:
            await asyncio.sleep(WATCH_INTERVAL_S)
            resident_bytes = memory.resident_bytes(pid)
            self._peak_bytes = max(self._peak_bytes, resident_bytes)
            if resident_bytes > limits.memory_bytes:
                found = f"{resident_bytes // 2**20} MiB"
                return self._end_for(worker.out_of_memory(limits, found))
            if loop.time() - began_s > limits.time_s:
                expected = f"an end within {limits.time_s:.0f} s"
                error = LimitError("task", expected, "none", reason="TASK_TIME_LIMIT")
                return self._end_for(error)
            if loop.time() - told_s > USAGE_INTERVAL_S:
                told_s = loop.time()
                usage = Usage(cpu_s=memory.cpu_s(pid), peak_rss_mib=self._peak_bytes / 2**20)
                self._messages.put_nowait(usage)

    def _end_for(self, error: LimitError) -> None:
        self._messages.put_nowait(error)
        self._process.kill()

    def _lost(self, spec: TaskSpec) -> RoelError:
        """The error for a child that ended without a word."""
        code = self._process.exitcode or 0
        if code >= 0:
            details = "the child ended by itself; what it said is above"
            return logged_failure(details, f"exit code {code}", spec.entrypoint)
        number = signal.Signals(-code)
        is_short_of_memory = (
            memory.kernel_kill_count() > self._kernel_kill_count
            or self._peak_bytes > NEAR_LIMIT_SHARE * spec.limits.memory_bytes
        )
        if is_short_of_memory:
            return worker.out_of_memory(spec.limits, f"one ended by {number.name} for more")
        if number in CRASHES:
            return logged_failure("the child crashed", number.name, spec.entrypoint)
        found = f"one ended by {number.name}"
        return UnavailableError("task", "a worker that finishes", found, reason="WORKER_LOST")

    def _listen(self, loop: asyncio.AbstractEventLoop) -> None:
        with self._pipe:
            while (message := worker.received(self._pipe)) is not None:
                if isinstance(message, Ready):
                    loop.call_soon_threadsafe(self._ready.set)
                else:
                    loop.call_soon_threadsafe(self._messages.put_nowait, message)
        self._process.join()
        loop.call_soon_threadsafe(self._ready.set)
        loop.call_soon_threadsafe(self._messages.put_nowait, None)
        loop.call_soon_threadsafe(self._ended.set)


async def last_message(
    receive: Callable[[], Awaitable[Message | None]], on_news: OnNews
) -> Message | None:
    """Pass the news on until work ends; None when nothing more can come."""
    while isinstance(message := await receive(), Progress | Partial | Usage):
        await on_news(message)
    return message


def result_of(message: Message | None, spec: TaskSpec) -> Any:
    """What the last message of work brought; raises what it tells of."""
    if isinstance(message, Done):
        return message.result
    if isinstance(message, Failed):
        raise logged_failure(message.traceback, message.fingerprint, spec.entrypoint)
    if isinstance(message, RoelError):
        raise message
    raise TypeError(f"{message} ends nothing")


def _send(pipe: Connection, spec: TaskSpec) -> None:
    try:
        pipe.send(spec)
    except OSError:
        return
