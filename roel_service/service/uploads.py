"""Uploads: received ahead, checked in threads, made durable in groups, acknowledged.

One call is one `Upload`. What it fills, a recording or a blob, is its `Sink`.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

from roel_service.errors import InputError, LimitError, RoelError, UnavailableError
from roel_service.service.settings import Settings
from roel_service.store.event_streams import writer_replaced

Item = TypeVar("Item")
Status = TypeVar("Status", covariant=True)


class Sink(Protocol[Item, Status]):
    """What an upload fills; all but the attributes is called in threads.

    Attributes:
        credit: how much may be under way, in the unit of `cost`.
    """

    credit: int

    def cost(self, request: Any) -> int:
        """What a request takes of the credit until it is durable."""

    def size_bytes(self, request: Any) -> int:
        """How much a request carries."""

    def check(self, request: Any) -> Item:
        """What a request carries, once it is known to be sound; raises `RoelError`."""

    def commit(self, items: list[Item]) -> Status:
        """Make items durable, in their order; raises `RoelError`."""


@dataclass(frozen=True, kw_only=True)
class _Received(Generic[Item]):
    """A request that is being checked."""

    cost: int
    size_bytes: int
    checking: asyncio.Task[Item]


class Upload(Generic[Item, Status]):
    """One call that uploads.

    A group is made durable when its first item is `commit_interval_s` old, when it is large, or
    when the client may be waiting for it. The items before a faulty one are made durable before
    the call ends with the error.
    """

    def __init__(
        self, requests: AsyncIterator[Any], sink: Sink[Item, Status], settings: Settings
    ) -> None:
        self._requests = requests
        self._sink = sink
        self._settings = settings
        self._received: deque[_Received[Item]] = deque()
        self._under_way = 0
        self._changed = asyncio.Event()
        self._end: RoelError | None = None

    def end(self, error: RoelError) -> None:
        """Let the call end with an error; what is under way is not made durable."""
        self._end = error
        self._changed.set()

    async def statuses(self) -> AsyncIterator[Status]:
        """The status after each group that became durable."""
        receiving = asyncio.create_task(self._receive())
        receiving.add_done_callback(self._note)
        try:
            while await self._has_next(receiving):
                await self._until_worthwhile(receiving)
                yield await self._commit(self._take())
        finally:
            receiving.cancel()

    async def _receive(self) -> None:
        while (request := await next_request(self._requests, self._settings)) is not None:
            cost = self._sink.cost(request)
            self._under_way += cost
            if self._under_way > self._sink.credit:
                expected = f"at most {self._sink.credit} that are not acknowledged"
                found = f"{self._under_way}"
                raise LimitError("upload", expected, found, reason="CREDIT_EXCEEDED")
            checking = asyncio.create_task(asyncio.to_thread(self._sink.check, request))
            checking.add_done_callback(self._note)
            size_bytes = self._sink.size_bytes(request)
            self._received.append(_Received(cost=cost, size_bytes=size_bytes, checking=checking))

    def _note(self, task: asyncio.Task[Any]) -> None:
        """A task ended; looking at its error keeps asyncio from logging one that nobody awaits."""
        if not task.cancelled():
            task.exception()
        self._changed.set()

    async def _has_next(self, receiving: asyncio.Task[None]) -> bool:
        """Whether an item waits to be committed; raises why the call has to end."""
        while True:
            self._changed.clear()
            if self._end is not None:
                raise self._end
            if self._received and self._received[0].checking.done():
                return True
            if not self._received and receiving.done():
                receiving.result()
                return False
            await self._changed.wait()

    async def _until_worthwhile(self, receiving: asyncio.Task[None]) -> None:
        clock = asyncio.get_running_loop()
        deadline_s = clock.time() + self._settings.commit_interval_s
        while not self._is_worthwhile(receiving):
            self._changed.clear()
            try:
                await asyncio.wait_for(self._changed.wait(), deadline_s - clock.time())
            except TimeoutError:
                return

    def _is_worthwhile(self, receiving: asyncio.Task[None]) -> bool:
        """Whether more than what is checked is not to be waited for."""
        checked = [item for item in self._received if item.checking.done()]
        return (
            self._end is not None
            or sum(item.size_bytes for item in checked) >= self._settings.commit_bytes
            or sum(item.cost for item in checked) * 2 >= self._sink.credit
            or (receiving.done() and len(checked) == len(self._received))
        )

    def _take(self) -> list[_Received[Item]]:
        """The sound items at the head; raises what is wrong with the first if it is not sound."""
        self._received[0].checking.result()
        group = []
        while self._received and _is_sound(self._received[0].checking):
            group.append(self._received.popleft())
        return group

    async def _commit(self, group: list[_Received[Item]]) -> Status:
        items = [item.checking.result() for item in group]
        status = await asyncio.to_thread(self._sink.commit, items)
        self._under_way -= sum(item.cost for item in group)
        return status


class OpenUploads:
    """The uploads that are going on, one for each target.

    Args:
        limit: most of them.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._uploads: dict[str, tuple[int, Upload[Any, Any]]] = {}

    @contextmanager
    def entered(self, target: str, fence: int, upload: Upload[Any, Any]) -> Iterator[None]:
        """Keep an upload here while it lasts, and end the one that it replaces.

        Raises:
            ConflictError: WRITER_REPLACED, a younger upload was faster.
            LimitError: TOO_MANY_UPLOADS.
        """
        previous_fence, previous = self._uploads.get(target, (0, None))
        if previous_fence > fence:
            raise writer_replaced(target)
        if previous is not None:
            previous.end(writer_replaced(target))
        elif len(self._uploads) >= self._limit:
            expected = f"at most {self._limit} at a time"
            raise LimitError("uploads", expected, "one more", reason="TOO_MANY_UPLOADS")
        entry = (fence, upload)
        self._uploads[target] = entry
        try:
            yield
        finally:
            # The upload that replaced this one may have ended before it.
            if self._uploads.get(target) is entry:
                del self._uploads[target]


async def next_request(requests: AsyncIterator[Any], settings: Settings) -> Any:
    """The next message of a call, None after the last.

    Raises:
        UnavailableError: UPLOAD_IDLE, none came for a long time; the client may call again.
    """
    try:
        async with asyncio.timeout(settings.upload_silence_s):
            return await anext(requests, None)
    except TimeoutError as error:
        expected = f"a message within {settings.upload_silence_s:g} s"
        raise UnavailableError("upload", expected, "silence", reason="UPLOAD_IDLE") from error


def request_part(request: Any, name: str) -> Any:
    """The part of an upload's message that has to be there; raises `InputError` UPLOAD_ORDER."""
    found = request.WhichOneof("part")
    if found != name:
        raise InputError("upload", f"a message with {name}", f"{found}", reason="UPLOAD_ORDER")
    return getattr(request, name)


def _is_sound(checking: asyncio.Task[Any]) -> bool:
    return checking.done() and checking.exception() is None
