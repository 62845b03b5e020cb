"""Where tasks run: in a thread, in a child of their own, or in a child that stays (`warm`)."""

from __future__ import annotations

import asyncio
import threading
from typing import Any, Protocol

from roel_service.errors import Cancelled
from roel_service.jobs import worker
from roel_service.jobs.supervisor import Child, last_message, result_of
from roel_service.jobs.task import Message, OnNews, Partial, TaskSpec
from roel_service.progress import Progress


class Executor(Protocol):
    """Runs tasks; it is told, never asked, and forgets what has ended."""

    @property
    def capacity(self) -> int:
        """Tasks at a time; whoever calls `run` more often waits or is refused."""
        ...

    async def run(self, spec: TaskSpec, on_news: OnNews) -> Any:
        """Result of a task; nothing of it runs any more when this has ended or was cancelled.

        Raises:
            RoelError: what the work raised.
            FaultError: it raised anything else.
        """
        ...

    async def close(self) -> None:
        """End whatever still runs."""
        ...


class InlineExecutor:
    """Threads of this process, without limits: the reference for the others.

    Work that is cancelled ends when it tells something the next time.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity

    async def run(self, spec: TaskSpec, on_news: OnNews) -> Any:
        loop = asyncio.get_running_loop()
        messages: asyncio.Queue[Message] = asyncio.Queue()
        is_cancelled = threading.Event()

        def tell(news: Progress | Partial) -> None:
            if is_cancelled.is_set():
                raise Cancelled
            loop.call_soon_threadsafe(messages.put_nowait, news)

        def work() -> None:
            message = worker.last_message(spec, tell, worker.Workshop())
            loop.call_soon_threadsafe(messages.put_nowait, message)

        running = asyncio.create_task(asyncio.to_thread(work))
        try:
            message = await last_message(messages.get, on_news)
        finally:
            is_cancelled.set()
            await asyncio.shield(running)
        return result_of(message, spec)

    async def close(self) -> None:
        """Nothing is left when `run` has ended."""


class ProcessExecutor:
    """One child for each attempt, gone when it ends."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity

    async def run(self, spec: TaskSpec, on_news: OnNews) -> Any:
        child = Child()
        try:
            return await child.run(spec, on_news)
        finally:
            await asyncio.shield(child.end())

    async def close(self) -> None:
        """Nothing is left when `run` has ended."""
