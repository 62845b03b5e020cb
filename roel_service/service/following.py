"""Cameras that are followed: each call talks to a child of its own while it lasts."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from typing import Any

from roel_service.errors import InputError, LimitError
from roel_service.jobs.questions import NextChunk, NextGuess, Saying, Told, TrackingBegins
from roel_service.jobs.supervisor import Child
from roel_service.jobs.task import Limits, News, TaskSpec
from roel_service.jobs.warm import WarmExecutor
from roel_service.service.settings import Settings
from roel_service.service.uploads import next_request
from roel_service.v1 import localization_pb2
from roel_service.wire.nouns import transform_from_proto

TRACKING_ENTRYPOINT = "roel_service.jobs.tracking:TrackingDesk"
# How long a call waits for a child.
PATIENCE_S = 2.0
# So many messages are read while others are worked off.
MAX_AHEAD_COUNT = 8


class Following:
    """Talks to children about cameras; a caller that goes away ends its child.

    While messages are worked off, the next ones are read, and handed over together: a child that
    has fallen behind catches up. They are `MAX_AHEAD_COUNT` at the most, so that HTTP/2 holds back a
    client that is faster than its child; nothing piles up here.

    Args:
        executor: the children; it bounds how many cameras are followed at a time.
    """

    def __init__(self, executor: WarmExecutor, settings: Settings) -> None:
        self._executor = executor
        self._settings = settings
        self._limits = Limits(
            memory_bytes=settings.task_memory_bytes, time_s=settings.interactive_time_s
        )

    async def poses(
        self,
        begins: TrackingBegins,
        requests: AsyncIterator[localization_pb2.TrackPosesRequest],
        listens: Callable[[], Awaitable[None]],
    ) -> AsyncIterator[localization_pb2.TrackPosesResponse]:
        """The poses, as the events for them come.

        Args:
            requests: what follows the first message.
            listens: tells the caller that its events are waited for from now on; a child that had to
                be started takes seconds, which a camera would not catch up with at once.

        Raises:
            RoelError: what the child raised.
            InputError: UPLOAD_ORDER, a second setup.
            LimitError: QUEUE_FULL, TASK_OUT_OF_MEMORY, TASK_TIME_LIMIT.
            UnavailableError: WORKER_LOST; UPLOAD_IDLE.
        """
        async with self._child() as child:
            await self._said(child, begins)
            await listens()
            async with self._reading(requests) as ahead:
                async for sayings in ahead.sayings():
                    told: Told = await self._said(child, sayings)
                    for pose in told.poses:
                        yield localization_pb2.TrackPosesResponse.FromString(pose)
                    if told.error is not None:
                        raise told.error

    @asynccontextmanager
    async def _reading(
        self, requests: AsyncIterator[localization_pb2.TrackPosesRequest]
    ) -> AsyncIterator[ReadAhead]:
        """The messages, while they are read; raises what reading them raised."""
        ahead = ReadAhead()
        reading = asyncio.create_task(ahead.read(requests, self._settings))
        try:
            yield ahead
            await reading
        finally:
            reading.cancel()
            await asyncio.gather(reading, return_exceptions=True)

    @asynccontextmanager
    async def _child(self) -> AsyncIterator[Child]:
        async with AsyncExitStack() as stack:
            try:
                # The child of a call that has just ended may still be on its way back.
                async with asyncio.timeout(PATIENCE_S):
                    held = self._executor.held(self._limits.memory_bytes)
                    child = await stack.enter_async_context(held)
            except TimeoutError as error:
                expected = f"fewer than {self._executor.capacity} cameras that are followed"
                raise LimitError("call", expected, "as many", reason="QUEUE_FULL") from error
            yield child

    async def _said(self, child: Child, saying: Any) -> Any:
        spec = TaskSpec(entrypoint=TRACKING_ENTRYPOINT, parameters=saying, limits=self._limits)
        return await child.run(spec, _ignore)


class ReadAhead:
    """What a caller has said, and nobody has heard yet."""

    def __init__(self) -> None:
        self._waiting: list[Saying] = []
        self._is_over = False
        self._news = asyncio.Event()
        self._room = asyncio.Semaphore(MAX_AHEAD_COUNT)

    async def read(self, requests: AsyncIterator[Any], settings: Settings) -> None:
        """Read to the end, no further ahead than there is room for; raises as `Following.poses`."""
        try:
            while (request := await next_request(requests, settings)) is not None:
                await self._room.acquire()
                self._waiting.append(_saying(request))
                self._news.set()
        finally:
            self._is_over = True
            self._news.set()

    async def sayings(self) -> AsyncIterator[list[Saying]]:
        """All that have come since the last time, at least one."""
        while self._waiting or not self._is_over:
            await self._news.wait()
            self._news.clear()
            heard, self._waiting = self._waiting, []
            for _ in heard:
                self._room.release()
            if heard:
                yield heard


def _saying(request: localization_pb2.TrackPosesRequest) -> Saying:
    kind = request.WhichOneof("part")
    if kind == "chunk":
        return NextChunk(seq=request.chunk.seq, data=request.chunk.data)
    if kind == "guess":
        return NextGuess(T_world_camera=transform_from_proto(request.guess, "guess"))
    raise InputError("stream", "a message with chunk or guess", f"{kind}", reason="UPLOAD_ORDER")


async def _ignore(news: News) -> None:
    """Nobody watches a camera but its caller."""
