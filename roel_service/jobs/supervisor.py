"""Child processes: start, listen, end."""

from __future__ import annotations

import asyncio
import multiprocessing
import signal
import threading
from collections.abc import Awaitable, Callable
from multiprocessing.connection import Connection
from typing import Any

from roel_service.errors import RoelError, UnavailableError
from roel_service.jobs.task import Done, Message, TaskSpec, run_task
from roel_service.progress import Progress

# How long a child may take to end after SIGTERM.
TERMINATION_GRACE_S = 0.5

# A fresh interpreter: it starts at once whatever the front holds, and shares no thread or lock.
_CONTEXT = multiprocessing.get_context("spawn")


async def run_in_child(spec: TaskSpec, on_progress: Callable[[Progress], Awaitable[None]]) -> Any:
    """Result of the work, done in a child that is gone afterwards, also when this is cancelled.

    Raises:
        RoelError: what the work raised; INTERNAL, when it raised anything else.
        UnavailableError: WORKER_LOST, the child was killed.
    """
    child = _Child(spec)
    try:
        return await _outcome(child, on_progress)
    finally:
        await asyncio.shield(child.end())


async def _outcome(child: _Child, on_progress: Callable[[Progress], Awaitable[None]]) -> Any:
    while True:
        message = await child.receive()
        if isinstance(message, Progress):
            await on_progress(message)
        elif isinstance(message, Done):
            return message.result
        elif isinstance(message, RoelError):
            raise message
        else:
            raise _lost(child.exit_code)


def _lost(exit_code: int) -> RoelError:
    """The error for a child that ended without a word."""
    if exit_code < 0:
        found = f"one ended by {signal.Signals(-exit_code).name}"
        return UnavailableError("build", "a worker that finishes", found, reason="WORKER_LOST")
    return RoelError("build", "a result", f"a fault, told in the server's log (code {exit_code})")


class _Child:
    """One process, and a thread that listens to it."""

    def __init__(self, spec: TaskSpec) -> None:
        self._messages: asyncio.Queue[Message | None] = asyncio.Queue()
        self._ended = asyncio.Event()
        pipe, child_end = _CONTEXT.Pipe(duplex=False)
        self._process = _CONTEXT.Process(target=run_task, args=(spec, child_end))
        self._process.start()
        child_end.close()
        listening = (pipe, asyncio.get_running_loop())
        threading.Thread(target=self._listen, args=listening, daemon=True).start()

    @property
    def exit_code(self) -> int:
        """Known once `receive` has returned None; negative if a signal ended the child."""
        return self._process.exitcode or 0

    async def receive(self) -> Message | None:
        """The next message; None when the child has ended."""
        return await self._messages.get()

    async def end(self) -> None:
        """Be sure that the child is gone: politely, then for certain."""
        self._process.terminate()
        try:
            await asyncio.wait_for(self._ended.wait(), TERMINATION_GRACE_S)
        except TimeoutError:
            self._process.kill()
            await self._ended.wait()

    def _listen(self, pipe: Connection, loop: asyncio.AbstractEventLoop) -> None:
        with pipe:
            while (message := _received(pipe)) is not None:
                loop.call_soon_threadsafe(self._messages.put_nowait, message)
        self._process.join()
        loop.call_soon_threadsafe(self._messages.put_nowait, None)
        loop.call_soon_threadsafe(self._ended.set)


def _received(pipe: Connection) -> Message | None:
    try:
        message: Message = pipe.recv()
    except (EOFError, OSError):
        return None
    return message
