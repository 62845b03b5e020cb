"""Cameras that are followed: each call talks to a child of its own while it lasts."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from typing import Any

from roel_service.errors import InputError, LimitError
from roel_service.jobs.questions import NextChunk, NextGuess, TrackingBegins
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


class Following:
    """Talks to children about cameras; a caller that goes away ends its child.

    No message is read before the one in front is worked off, so that HTTP/2 holds back a client
    that is faster than its child; nothing piles up here.

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
    ) -> AsyncIterator[localization_pb2.TrackPosesResponse]:
        """The poses, as the events for them come.

        Raises:
            RoelError: what the child raised.
            InputError: UPLOAD_ORDER, a second setup.
            LimitError: QUEUE_FULL, TASK_OUT_OF_MEMORY, TASK_TIME_LIMIT.
            UnavailableError: WORKER_LOST; UPLOAD_IDLE.
        """
        async with self._child() as child:
            await self._said(child, begins)
            while (request := await next_request(requests, self._settings)) is not None:
                for answer in await self._said(child, _saying(request)):
                    yield localization_pb2.TrackPosesResponse.FromString(answer)

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

    async def _said(self, child: Child, saying: Any) -> list[bytes]:
        spec = TaskSpec(entrypoint=TRACKING_ENTRYPOINT, parameters=saying, limits=self._limits)
        answers: list[bytes] = await child.run(spec, _ignore)
        return answers


def _saying(request: localization_pb2.TrackPosesRequest) -> NextChunk | NextGuess:
    kind = request.WhichOneof("part")
    if kind == "chunk":
        return NextChunk(seq=request.chunk.seq, data=request.chunk.data)
    if kind == "guess":
        return NextGuess(T_world_camera=transform_from_proto(request.guess, "guess"))
    raise InputError("stream", "a message with chunk or guess", f"{kind}", reason="UPLOAD_ORDER")


async def _ignore(news: News) -> None:
    """Nobody watches a camera but its caller."""
