"""Children that stay, for calls that somebody waits for: libraries and caches are ready."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from roel_service.errors import LimitError
from roel_service.jobs.supervisor import Child
from roel_service.jobs.task import OnNews, TaskSpec

# Native libraries lose a little memory with every call; a child that took this many is replaced.
MAX_CALL_COUNT = 1000


class WarmExecutor:
    """A few children, each with one call at a time; one that breaks is replaced at once.

    Args:
        capacity: children.
        queued_count: calls that may wait for one.
        preload: entry point that the calls name; ready before the first one.
    """

    def __init__(self, capacity: int, queued_count: int, preload: str = "") -> None:
        self.capacity = capacity
        self._preload = preload
        self._child_count = 0
        self._admitted_count = 0
        self._max_admitted_count = capacity + queued_count
        self._idle: asyncio.LifoQueue[_WarmChild] = asyncio.LifoQueue()

    def start(self) -> None:
        """Start the children that the first calls would start otherwise, while nobody waits."""
        while self._child_count < self.capacity:
            self._child_count += 1
            self._idle.put_nowait(_WarmChild(self._preload))

    async def run(self, spec: TaskSpec, on_news: OnNews) -> Any:
        """As every executor, and raises `LimitError` QUEUE_FULL."""
        async with self.held(spec.limits.memory_bytes) as child:
            return await child.run(spec, on_news)

    @asynccontextmanager
    async def held(self, memory_bytes: int) -> AsyncIterator[Child]:
        """A child for several calls, one after the other, which it may remember.

        Args:
            memory_bytes: a child that holds more at the end is replaced.

        Raises:
            LimitError: QUEUE_FULL.
        """
        if self._admitted_count == self._max_admitted_count:
            raise LimitError("call", "room in the queue", "a full one", reason="QUEUE_FULL")
        self._admitted_count += 1
        try:
            child = await self._ready_child()
            child.count_call()
            try:
                yield child
            finally:
                await asyncio.shield(self._give_back(child, memory_bytes))
        finally:
            self._admitted_count -= 1

    async def close(self) -> None:
        """End the children that wait; `run` must not be called any more."""
        while not self._idle.empty():
            await self._idle.get_nowait().end()

    async def _ready_child(self) -> _WarmChild:
        if self._idle.empty() and self._child_count < self.capacity:
            self._child_count += 1
            return _WarmChild(self._preload)
        child = await self._idle.get()
        # It may have been killed while it waited.
        return child if child.is_reusable else _WarmChild(self._preload)

    async def _give_back(self, child: _WarmChild, memory_bytes: int) -> None:
        if child.is_fit(memory_bytes):
            self._idle.put_nowait(child)
            return
        self._idle.put_nowait(_WarmChild(self._preload))
        await child.end()


class _WarmChild(Child):
    """A child that counts its calls, of which one may be a whole conversation."""

    def __init__(self, preload: str) -> None:
        super().__init__(preload)
        self._call_count = 0

    def count_call(self) -> None:
        """Another one begins."""
        self._call_count += 1

    def is_fit(self, memory_bytes: int) -> bool:
        """Whether it can take another call: sound, not too old and not too fat."""
        return (
            self.is_reusable
            and self._call_count < MAX_CALL_COUNT
            and self.resident_bytes <= memory_bytes
        )
