"""Builds in turn: a bounded queue, a bounded number of children, every step on record."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from functools import partial

from roel_service.errors import LimitError, RoelError, UnavailableError
from roel_service.jobs.faults import logged_fault
from roel_service.jobs.supervisor import run_in_child
from roel_service.jobs.task import TaskSpec
from roel_service.progress import Progress
from roel_service.store.operations import Operations
from roel_service.store.records import OperationRecord
from roel_service.wire.errors import status_from_error

logger = logging.getLogger(__name__)

STARTING = Progress(stage="", done_count=0, total_count=0, fraction=0.0)

# What becomes a build's operation and work once it is admitted; called in a thread.
BeginBuild = Callable[[], tuple[OperationRecord, TaskSpec]]


class Changes:
    """Wakes whoever waits for an operation to change."""

    def __init__(self) -> None:
        self._next = asyncio.Event()

    def next(self) -> asyncio.Event:
        """Is set at the next change; to be taken before looking at the record."""
        return self._next

    def announce(self) -> None:
        """Something changed."""
        self._next.set()
        self._next = asyncio.Event()


class Scheduler:
    """Runs builds in children and keeps their operations true.

    Args:
        operations: where they live.
        concurrent_count: children at a time.
        queued_count: builds that may wait for a child.
    """

    def __init__(self, operations: Operations, concurrent_count: int, queued_count: int) -> None:
        self._operations = operations
        self._children = asyncio.Semaphore(concurrent_count)
        self._free_count = concurrent_count + queued_count
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._draining = False
        self.changes = Changes()

    async def submit(self, begin: BeginBuild) -> OperationRecord:
        """Admit a build.

        Raises:
            LimitError: QUEUE_FULL.
            UnavailableError: DRAINING.
            RoelError: whatever `begin` raises.
        """
        if self._draining:
            reason = "DRAINING"
            raise UnavailableError("server", "one that takes work", "one that ends", reason=reason)
        if self._free_count == 0:
            raise LimitError("build", "room in the queue", "a full one", reason="QUEUE_FULL")
        self._free_count -= 1
        # The row must not be left without a task when the caller goes away meanwhile.
        return await asyncio.shield(self._begin(begin))

    async def cancel(self, operation_id: str) -> None:
        """End a build, and return when it has ended; one that is final stays as it is."""
        task = self._tasks.get(operation_id)
        if task is not None:
            task.cancel()
            await asyncio.wait({task})

    async def drain(self) -> None:
        """End all builds and take no more; they fail with DRAINING."""
        self._draining = True
        for operation_id in list(self._tasks):
            await self.cancel(operation_id)

    async def fail_unfinished(self) -> None:
        """Fail what a server that died left behind."""
        found = "a server that ended during the build"
        lost = UnavailableError("build", "a worker that finishes", found, reason="WORKER_LOST")
        for record in await asyncio.to_thread(self._operations.unfinished):
            await self._fail(record.id, lost)

    async def _begin(self, begin: BeginBuild) -> OperationRecord:
        try:
            operation, spec = await asyncio.to_thread(begin)
        except BaseException:
            self._free_count += 1
            raise
        task = asyncio.create_task(self._run(operation.id, spec))
        self._tasks[operation.id] = task
        task.add_done_callback(lambda _: self._forget(operation.id))
        return operation

    def _forget(self, operation_id: str) -> None:
        del self._tasks[operation_id]
        self._free_count += 1
        self.changes.announce()

    async def _run(self, operation_id: str, spec: TaskSpec) -> None:
        """One build from its turn to its end, however it ends."""
        advance = partial(self._record, self._operations.advance, operation_id)
        try:
            async with self._children:
                await advance(STARTING)
                built = await run_in_child(spec, advance)
            await self._record(self._operations.succeed, operation_id, built)
        except asyncio.CancelledError:
            await self._cancelled(operation_id)
        except RoelError as error:
            await self._fail(operation_id, error)
        except Exception as error:  # the border of the build: whatever is left is a bug
            await self._fail(operation_id, logged_fault(error, f"operation {operation_id}"))

    async def _cancelled(self, operation_id: str) -> None:
        if self._draining:
            found = "one that ends"
            error = UnavailableError("server", "one that builds", found, reason="DRAINING")
            await self._fail(operation_id, error)
        else:
            await self._record(self._operations.cancel, operation_id)

    async def _fail(self, operation_id: str, error: RoelError) -> None:
        status = status_from_error(error).SerializeToString(deterministic=True)
        await self._record(self._operations.fail, operation_id, status)

    async def _record(self, change: Callable[..., OperationRecord], *arguments: object) -> None:
        """Make a change durable, then tell whoever waits for it."""
        record = await asyncio.to_thread(change, *arguments)
        if record.state.is_final:
            logger.info("%s %s: %s", record.method.value, record.id, record.state.value)
        self.changes.announce()
