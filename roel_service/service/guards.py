"""Guards around every call: errors, drain, access, limits.

Each is entered before the call and left after it. Those further in raise a `RoelError` to refuse;
`told_errors`, the outermost, makes it the answer.
"""

from __future__ import annotations

import asyncio
from collections import defaultdict
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, nullcontext
from typing import Any

from google.rpc import error_details_pb2
from grpc_status import rpc_status

from roel_service.errors import DeadlineError, LimitError, RoelError, UnavailableError
from roel_service.jobs.faults import logged_fault
from roel_service.service.calls import Call
from roel_service.service.rules import Pool, rule_of
from roel_service.service.settings import Settings
from roel_service.store.faults import store_failure
from roel_service.wire.errors import status_from_error


@asynccontextmanager
async def told_errors(call: Call) -> AsyncIterator[None]:
    """Ends a failed call with a `google.rpc.Status`; nobody else aborts.

    A `RoelError` is told with all its details, and so is a disk that fails. Anything else is a bug: it
    is logged with an id, and the caller learns the id alone.
    """
    try:
        yield
    except RoelError as error:
        await _abort(call, error)
    except Exception as error:  # the border of the server: whatever is left is a bug
        await _abort(call, store_failure(error) or logged_fault(error, call.method))


async def _abort(call: Call, error: RoelError) -> None:
    status = status_from_error(error)
    status.details.add().Pack(error_details_pb2.RequestInfo(request_id=call.request_id))
    await call.context.abort_with_status(rpc_status.to_status(status))


class Drain:
    """Refuses calls once the server is about to end, and ends those that would last.

    Their clients go on with them when a server is back: nothing that was acknowledged is lost.
    """

    def __init__(self) -> None:
        self._uploads: set[asyncio.Task[Any]] = set()
        self._others: set[asyncio.Task[Any]] = set()
        self._ended: set[asyncio.Task[Any]] = set()
        self.has_begun = False

    @asynccontextmanager
    async def __call__(self, call: Call) -> AsyncIterator[None]:
        """Guard one call."""
        pool = rule_of(call.method).pool
        if self.has_begun and pool is not Pool.NONE:
            raise _draining()
        task = asyncio.current_task()
        assert task is not None
        calls = self._uploads if pool is Pool.UPLOADS else self._others
        calls.add(task)
        try:
            yield
        except asyncio.CancelledError:
            if task not in self._ended:
                raise
            task.uncancel()
            raise _draining() from None
        finally:
            calls.discard(task)
            self._ended.discard(task)

    def begin(self) -> None:
        """Refuse new calls, but for those that wait for a build to end, and end the uploads."""
        self.has_begun = True
        self._end(self._uploads)

    async def finish(self, grace_s: float) -> None:
        """End the calls that are still there after this long; the others end by themselves."""
        if self._others:
            await asyncio.wait(self._others, timeout=grace_s)
        self._end(self._others)

    def _end(self, calls: set[asyncio.Task[Any]]) -> None:
        for task in calls:
            self._ended.add(task)
            task.cancel()


def _draining() -> UnavailableError:
    return UnavailableError(
        "server", "one that takes calls", "one that is about to end", reason="DRAINING"
    )


class CallLimits:
    """Bounds the calls at work; a few more may wait for their turn."""

    def __init__(self, settings: Settings) -> None:
        # Twice as many as may go on: each may be taken over by a younger call.
        self._uploads = Places(2 * settings.open_uploads, 0)
        self._interactive = Places(settings.interactive_workers, settings.interactive_queued)
        self._streams = Places(settings.open_streams, 0)
        self._methods: defaultdict[str, Places] = defaultdict(
            lambda: Places(settings.calls_in_flight, settings.calls_waiting)
        )

    def is_full(self, method: str) -> bool:
        """Whether one more call would be refused."""
        return rule_of(method).pool is Pool.METHOD and self._methods[method].is_full

    def refusal(self, method: str) -> LimitError:
        """What is told to a call of a method that is full."""
        return self._methods[method].refusal(method)

    @asynccontextmanager
    async def __call__(self, call: Call) -> AsyncIterator[None]:
        """Guard one call."""
        pool = rule_of(call.method).pool
        if pool is Pool.NONE:
            place: Any = nullcontext()
        elif pool is Pool.UPLOADS:
            place = self._uploads.taken(call)
        elif pool is Pool.INTERACTIVE:
            place = self._interactive.taken(call)
        elif pool is Pool.STREAMS:
            place = self._streams.taken(call)
        else:
            place = self._methods[call.method].taken(call)
        async with place:
            yield


class FullMethods:
    """The gate before all guards: refuses calls of a method that has no room, at next to no cost.

    Most of what a refusal costs is telling it, so that its status is made once for each method; it
    carries no request id, and the log does not mention it.

    Args:
        note: is told of the method and how the call ended.
    """

    def __init__(self, limits: CallLimits, note: Callable[[str, str], None]) -> None:
        self._limits = limits
        self._note = note
        self._statuses: dict[str, Any] = {}

    def __call__(self, method: str) -> Any:
        """The status with which a call is refused, None for one that is let through."""
        if not self._limits.is_full(method):
            return None
        self._note(method, "RESOURCE_EXHAUSTED")
        if method not in self._statuses:
            status = status_from_error(self._limits.refusal(method))
            self._statuses[method] = rpc_status.to_status(status)
        return self._statuses[method]


class Places:
    """Room for some calls at work and some that wait.

    Args:
        working_count: calls at a time.
        waiting_count: calls that may wait for a place.
    """

    # Weight of the newest call in the running mean of how long calls take.
    NEWEST_WEIGHT = 0.1

    def __init__(self, working_count: int, waiting_count: int) -> None:
        self._working_count = working_count
        self._free = asyncio.Semaphore(working_count)
        self._room_count = working_count + waiting_count
        self._taken_count = 0
        self._mean_s = 0.0

    @property
    def is_full(self) -> bool:
        """Whether nobody else may even wait."""
        return self._taken_count >= self._room_count

    def refusal(self, method: str) -> LimitError:
        """What is told to a call for which there is no room."""
        expected = f"at most {self._room_count} calls at a time"
        return LimitError(method, expected, "one more", reason="QUEUE_FULL")

    @asynccontextmanager
    async def taken(self, call: Call) -> AsyncIterator[None]:
        """Work in one of the places.

        Raises:
            LimitError: QUEUE_FULL.
            DeadlineError: DEADLINE_TOO_SHORT, the wait would outlast the caller's patience.
        """
        self._check(call)
        self._taken_count += 1
        try:
            async with self._free:
                loop = asyncio.get_running_loop()
                start_s = loop.time()
                try:
                    yield
                finally:
                    spent_s = loop.time() - start_s
                    self._mean_s += self.NEWEST_WEIGHT * (spent_s - self._mean_s)
        finally:
            self._taken_count -= 1

    def _check(self, call: Call) -> None:
        if self.is_full:
            raise self.refusal(call.method)
        waiting_count = max(0, self._taken_count + 1 - self._working_count)
        wait_s = self._mean_s * waiting_count / self._working_count
        if call.end_s is None:
            return
        remaining_s = call.end_s - asyncio.get_running_loop().time()
        if remaining_s < wait_s:
            expected, found = (
                f"a deadline beyond the wait of {wait_s:.3f} s",
                f"{remaining_s:.3f} s",
            )
            raise DeadlineError(call.method, expected, found)
