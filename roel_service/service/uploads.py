"""Uploads: received ahead, checked in a thread, made durable in groups, acknowledged.

One call is one `Upload`. What it fills, a recording or a blob, is its `Sink`.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Coroutine, Iterator
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

    def check(self, request: Any) -> Item:
        """What a request carries, once it is known to be sound; raises `RoelError`."""

    def size_bytes(self, item: Any) -> int:
        """How much that is."""

    def commit(self, items: list[Item]) -> Status:
        """Make items durable, in their order; raises `RoelError`."""


@dataclass(frozen=True, kw_only=True)
class _Checked(Generic[Item]):
    """What a sound request carries."""

    item: Item
    cost: int
    size_bytes: int


class Upload(Generic[Item, Status]):
    """One call that uploads.

    Requests are received, checked and made durable side by side, each by as many at a time as
    there are: handing over one by one between threads would take as long as the work.

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
        # What costs so much of the credit.
        self._received: list[tuple[Any, int]] = []
        self._checked: list[_Checked[Item]] = []
        self._under_way = 0
        self._has_received = asyncio.Event()
        self._has_checked = asyncio.Event()
        self._end: RoelError | None = None

    def end(self, error: RoelError) -> None:
        """Let the call end with an error; what is under way is not made durable."""
        self._end = error
        self._has_checked.set()

    async def statuses(self) -> AsyncIterator[Status]:
        """The status after each group that became durable."""
        receiving = _noted(self._receive(), self._has_received)
        checking = _noted(self._check(receiving), self._has_checked)
        try:
            while await self._has_group(checking):
                yield await self._commit()
        finally:
            receiving.cancel()
            checking.cancel()

    async def _receive(self) -> None:
        while (request := await next_request(self._requests, self._settings)) is not None:
            cost = self._sink.cost(request)
            self._under_way += cost
            if self._under_way > self._sink.credit:
                expected = f"at most {self._sink.credit} that are not acknowledged"
                found = f"{self._under_way}"
                raise LimitError("upload", expected, found, reason="CREDIT_EXCEEDED")
            self._received.append((request, cost))
            self._has_received.set()

    async def _check(self, receiving: asyncio.Task[None]) -> None:
        """Check what was received; raises what is wrong with it, or why nothing more comes."""
        while await self._has_requests(receiving):
            requests, self._received = self._received, []
            checked, error = await asyncio.to_thread(self._sound, requests)
            self._checked += checked
            self._has_checked.set()
            if error is not None:
                raise error

    async def _has_requests(self, receiving: asyncio.Task[None]) -> bool:
        while not self._received:
            if receiving.done():
                receiving.result()
                return False
            self._has_received.clear()
            await self._has_received.wait()
        return True

    def _sound(
        self, requests: list[tuple[Any, int]]
    ) -> tuple[list[_Checked[Item]], RoelError | None]:
        """The requests before the first faulty one, and what is wrong with that."""
        checked: list[_Checked[Item]] = []
        for request, cost in requests:
            try:
                item = self._sink.check(request)
            except RoelError as error:
                return checked, error
            size_bytes = self._sink.size_bytes(item)
            checked.append(_Checked(item=item, cost=cost, size_bytes=size_bytes))
        return checked, None

    async def _has_group(self, checking: asyncio.Task[None]) -> bool:
        """Wait for items that are worth a commit; raises why the call has to end."""
        clock = asyncio.get_running_loop()
        due_s: float | None = None
        while not self._is_worthwhile(checking):
            if due_s is None and self._checked:
                due_s = clock.time() + self._settings.commit_interval_s
            self._has_checked.clear()
            try:
                async with asyncio.timeout_at(due_s):
                    await self._has_checked.wait()
            except TimeoutError:
                break
        if self._end is not None:
            raise self._end
        if not self._checked:
            checking.result()
        return bool(self._checked)

    def _is_worthwhile(self, checking: asyncio.Task[None]) -> bool:
        """Whether more than what is checked is not to be waited for."""
        return (
            self._end is not None
            or checking.done()
            or sum(item.size_bytes for item in self._checked) >= self._settings.commit_bytes
            or sum(item.cost for item in self._checked) * 2 >= self._sink.credit
        )

    async def _commit(self) -> Status:
        group, self._checked = self._checked, []
        status = await asyncio.to_thread(self._sink.commit, [checked.item for checked in group])
        self._under_way -= sum(checked.cost for checked in group)
        return status


def _noted(work: Coroutine[Any, Any, None], ended: asyncio.Event) -> asyncio.Task[None]:
    """A task that sets an event when it ends."""

    def note(task: asyncio.Task[None]) -> None:
        # Looking at the error keeps asyncio from logging one that nobody awaits.
        if not task.cancelled():
            task.exception()
        ended.set()

    task = asyncio.create_task(work)
    task.add_done_callback(note)
    return task


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
