"""Operations in turn: tasks are taken from their rows, run, and ended there."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import uuid
from collections.abc import Callable, Coroutine, Mapping
from dataclasses import dataclass
from typing import Any

from roel_service.errors import ConflictError, LimitError, RoelError, UnavailableError
from roel_service.jobs.executors import Executor
from roel_service.jobs.faults import logged_fault
from roel_service.jobs.metadata import Metadata
from roel_service.jobs.preparation import Prepare
from roel_service.jobs.retries import MAX_ATTEMPT_COUNT, Retry, judge
from roel_service.jobs.task import GIB, Limits, News, Partial, TaskSpec, Usage
from roel_service.progress import Progress
from roel_service.store.faults import store_failure
from roel_service.store.operations import Operations
from roel_service.store.records import (
    OperationMethod,
    OperationRecord,
    TaskRecord,
    now_us,
)
from roel_service.store.tasks import Tasks
from roel_service.wire import names
from roel_service.wire.errors import status_from_error

logger = logging.getLogger(__name__)

STARTING = Progress(stage="", done_count=0, total_count=0, fraction=0.0)

# A lease is held for 30 s: two renewals may fail before it is lost.
RENEWAL_INTERVAL_S = 10.0
# Whatever happens is noticed at once; only the time until a retry passes without a notice.
POLL_INTERVAL_S = 0.5

# Makes the rows of an operation once it is admitted; called in a thread.
Begin = Callable[[], OperationRecord]


@dataclass(frozen=True, kw_only=True)
class Policy:
    """What operations may use.

    Attributes:
        unfinished_count: operations that may be queued or running.
        memory_bytes, max_memory_bytes: limit of a first attempt, and of one that is retried
            because that was too little.
        time_s: wall clock of an attempt.
        retry_delay_s: mean delay of the second attempt.
    """

    unfinished_count: int
    memory_bytes: int = 2 * GIB
    max_memory_bytes: int = 4 * GIB
    time_s: float = 3600.0
    retry_delay_s: float = 1.0

    def limits(self, task: TaskRecord, extra_s: float) -> Limits:
        """Those of the next attempt, which may take longer than others by so much."""
        memory_bytes = min(self.memory_bytes << task.memory_doublings, self.max_memory_bytes)
        return Limits(memory_bytes=memory_bytes, time_s=self.time_s + extra_s)

    @property
    def max_memory_doublings(self) -> int:
        """How often the memory limit can be doubled."""
        return max(0, (self.max_memory_bytes // self.memory_bytes).bit_length() - 1)


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
    """Runs tasks and keeps their operations true; the rows decide, whoever wrote them.

    Args:
        operations, tasks: where they live.
        executor: where tasks run.
        prepare: what the tasks of each method are to do.
        policy: what they may use.
        on_end: is told of every operation that ended, in a thread.
    """

    def __init__(
        self,
        operations: Operations,
        tasks: Tasks,
        executor: Executor,
        prepare: Mapping[OperationMethod, Prepare],
        policy: Policy,
        on_end: Callable[[OperationRecord], None] = lambda record: None,
    ) -> None:
        self._operations = operations
        self._tasks = tasks
        self._executor = executor
        self._prepare = prepare
        self._policy = policy
        self._on_end = on_end
        self._owner = uuid.uuid4().hex
        self._attempts: dict[str, tuple[TaskRecord, asyncio.Task[None]]] = {}
        self._loops: list[asyncio.Task[None]] = []
        self._admission = asyncio.Lock()
        self._work = asyncio.Event()
        self._draining = False
        self.changes = Changes()

    async def start(self) -> None:
        """Take up what a server before this one left behind, then whatever comes."""
        await asyncio.to_thread(self._tasks.expire_leases)
        found = "one that an older release left behind"
        error = UnavailableError("task", "a worker that finishes", found, reason="WORKER_LOST")
        for operation_id in await asyncio.to_thread(self._operations.without_task):
            await asyncio.to_thread(self._operations.abandon, operation_id, _encoded(error))
        loops = (self._take_tasks, self._renew)
        self._loops = [asyncio.create_task(self._for_ever(loop)) for loop in loops]

    async def submit(self, begin: Begin) -> OperationRecord:
        """Admit an operation.

        Raises:
            LimitError: QUEUE_FULL, QUOTA_CONCURRENT_BUILDS.
            UnavailableError: DRAINING.
            RoelError: whatever `begin` raises.
        """
        self.check_serving()
        # The operation must be announced although the caller goes away meanwhile.
        return await asyncio.shield(self._admit(begin))

    def check_serving(self) -> None:
        """Raise `UnavailableError` DRAINING when this server will do no more work."""
        if self._draining:
            found = "one that ends"
            raise UnavailableError("server", "one that works", found, reason="DRAINING")

    async def cancel(self, operation_id: str) -> None:
        """End an operation, and return when nothing of it runs; one that has ended stays so."""
        await asyncio.to_thread(self._operations.cancel, operation_id)
        self.changes.announce()
        attempts = [
            running
            for task, running in self._attempts.values()
            if task.operation_id == operation_id
        ]
        await _ended(attempts)

    async def drain(self) -> None:
        """Take no more work, and give back what is under way; the next server continues it."""
        self._draining = True
        await _ended([*self._loops, *(running for _, running in self._attempts.values())])
        self.changes.announce()

    async def _admit(self, begin: Begin) -> OperationRecord:
        async with self._admission:
            unfinished = await asyncio.to_thread(self._operations.unfinished)
            if len(unfinished) >= self._policy.unfinished_count:
                raise LimitError("task", "room in the queue", "a full one", reason="QUEUE_FULL")
            await asyncio.to_thread(self._operations.check_quota)
            record = await asyncio.to_thread(begin)
        self._work.set()
        return record

    async def _for_ever(self, loop: Callable[[], Coroutine[Any, Any, None]]) -> None:
        while True:
            try:
                await loop()
            except Exception as error:  # the border of the scheduler, which must go on
                logged_fault(error, "the scheduler")
                await asyncio.sleep(POLL_INTERVAL_S)

    async def _take_tasks(self) -> None:
        while True:
            self._work.clear()
            while len(self._attempts) < self._executor.capacity:
                task = await asyncio.to_thread(self._tasks.lease, self._owner)
                if task is None:
                    break
                self._begin_attempt(task)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(POLL_INTERVAL_S):
                    await self._work.wait()

    async def _renew(self) -> None:
        while True:
            await asyncio.sleep(RENEWAL_INTERVAL_S)
            held = await asyncio.to_thread(self._tasks.renew, self._owner)
            lost = [running for key, (_, running) in self._attempts.items() if key not in held]
            await _ended(lost)

    def _begin_attempt(self, task: TaskRecord) -> None:
        running = asyncio.create_task(self._attempt(task))
        self._attempts[task.id] = (task, running)
        running.add_done_callback(lambda _: self._forget(task.id))

    def _forget(self, task_id: str) -> None:
        del self._attempts[task_id]
        self._work.set()
        self.changes.announce()

    async def _attempt(self, task: TaskRecord) -> None:
        """One attempt, however it ends."""
        try:
            await self._record(self._operations.succeed, task.lease, await self._outcome(task))
        except asyncio.CancelledError:
            await self._give_back(task)
        except RoelError as error:
            await self._settle(task, error)
        except Exception as error:  # the border of the operation: whatever is left is a bug
            fault = store_failure(error) or logged_fault(error, f"operation {task.operation_id}")
            await self._settle(task, fault)

    async def _outcome(self, task: TaskRecord) -> Any:
        if task.attempt_count > MAX_ATTEMPT_COUNT:
            found = f"{MAX_ATTEMPT_COUNT} servers that ended during the work"
            raise UnavailableError("task", "a worker that finishes", found, reason="WORKER_LOST")
        metadata = Metadata(task.attempt_count)
        await self._advance(task, STARTING, metadata)
        operation = await asyncio.to_thread(self._operations.get, task.operation_id)
        prepare = self._prepare[operation.method]
        work = await asyncio.to_thread(prepare, operation, task)
        limits = self._policy.limits(task, work.extra_s)
        spec = TaskSpec(entrypoint=work.entrypoint, parameters=work.parameters, limits=limits)
        return await self._executor.run(spec, lambda news: self._hear(task, metadata, news))

    async def _hear(self, task: TaskRecord, metadata: Metadata, news: News) -> None:
        if isinstance(news, Usage):
            # Told with the next progress: on its own it is not worth a write.
            metadata.note_usage(news)
        elif isinstance(news, Partial):
            record = await self._record(self._operations.preview, task.lease, news.result)
            metadata.note_preview(names.map_version_name(record.map_id, record.version))
        else:
            metadata.note_progress(news)
            await self._advance(task, news, metadata)

    async def _advance(self, task: TaskRecord, progress: Progress, metadata: Metadata) -> None:
        advance = self._operations.advance
        await self._record(advance, task.lease, progress, metadata.encoded())

    async def _settle(self, task: TaskRecord, error: RoelError) -> None:
        """Try again, or end the operation with the error."""
        verdict = judge(
            task,
            error,
            delay_s=self._policy.retry_delay_s,
            max_memory_doublings=self._policy.max_memory_doublings,
        )
        if isinstance(verdict, Retry):
            logger.warning("attempt %d of task %s: %s", task.attempt_count, task.id, error)
            await self._end_attempt(self._requeue(task, verdict))
        else:
            fail = self._operations.fail
            await self._end_attempt(self._record(fail, task.lease, _encoded(verdict)))

    async def _give_back(self, task: TaskRecord) -> None:
        """Leave the task to the next server as if this attempt had never begun."""
        unchanged = Retry(
            delay_s=0.0,
            memory_doublings=task.memory_doublings,
            failure_hash=task.failure_hash,
        )
        requeued = self._requeue(task, unchanged, attempt_count=task.attempt_count - 1)
        await self._end_attempt(requeued)

    async def _requeue(
        self, task: TaskRecord, retry: Retry, attempt_count: int | None = None
    ) -> None:
        record = await asyncio.to_thread(
            self._operations.requeue,
            task.lease,
            not_before_us=now_us() + round(1e6 * retry.delay_s),
            attempt_count=task.attempt_count if attempt_count is None else attempt_count,
            memory_doublings=retry.memory_doublings,
            failure_hash=retry.failure_hash,
        )
        logger.info("%s %s: to be tried again", record.method.value, record.id)

    async def _end_attempt(self, ending: Coroutine[Any, Any, object]) -> None:
        """An attempt that was cancelled or replaced has no say any more."""
        try:
            await ending
        except ConflictError as error:
            logger.info("an attempt does not count: %s", error)

    async def _record(
        self, change: Callable[..., OperationRecord], *arguments: object
    ) -> OperationRecord:
        """Make a change durable, then tell whoever waits for it."""
        record = await asyncio.to_thread(change, *arguments)
        if record.state.is_final:
            logger.info("%s %s: %s", record.method.value, record.id, record.state.value)
            await asyncio.to_thread(self._on_end, record)
        self.changes.announce()
        return record


def _encoded(error: RoelError) -> bytes:
    return bytes(status_from_error(error).SerializeToString(deterministic=True))


async def _ended(running: list[asyncio.Task[None]]) -> None:
    """Cancel, and wait until nothing runs any more."""
    for task in running:
        task.cancel()
    if running:
        await asyncio.wait(running)
