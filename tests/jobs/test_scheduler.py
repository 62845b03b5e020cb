import asyncio
import json
from contextlib import asynccontextmanager

import pytest
from google.rpc import status_pb2

from roel_service.errors import LimitError, NotFoundError, UnavailableError
from roel_service.jobs import scheduler as scheduling
from roel_service.jobs.executors import InlineExecutor
from roel_service.jobs.preparation import Prepared
from roel_service.jobs.scheduler import Policy, Scheduler
from roel_service.store.records import (
    OperationMethod,
    OperationState,
    TaskRecord,
    TaskState,
    VersionState,
)
from roel_service.store.store import Store
from roel_service.v1 import operations_pb2
from roel_service.wire.errors import error_from_status

from ..store.samples import finalized


@pytest.fixture
def store(tmp_path):
    with Store(tmp_path / "data") as opened:
        finalized(opened, "walk")
        opened.maps.create("house")
        yield opened


def begin(store, name, parameters=None):
    """A build that runs a function of `sample_tasks`."""
    encoded = json.dumps([name, parameters]).encode()
    return lambda: store.builds.begin("house", "walk", parameters=encoded)


def prepare(operation, task):
    name, parameters = json.loads(task.parameters)
    return Prepared(f"sample_tasks:{name}", parameters)


@asynccontextmanager
async def scheduling_on(store, capacity=1, **policy):
    policy = {"unfinished_count": 2, "retry_delay_s": 0.01, **policy}
    executor = InlineExecutor(capacity)
    methods = {OperationMethod.BUILD_MAP: prepare}
    made = Scheduler(store.operations, store.tasks, executor, methods, Policy(**policy))
    await made.start()
    try:
        yield made
    finally:
        await made.drain()


async def reach(scheduler, store, operation, wanted):
    """The record once `wanted` holds for it."""
    while True:
        changed = scheduler.changes.next()
        record = store.operations.get(operation.id)
        if wanted(record):
            return record
        await asyncio.wait_for(changed.wait(), 30)


async def ended(scheduler, store, operation):
    return await reach(scheduler, store, operation, lambda record: record.state.is_final)


async def at_work(scheduler, store, operation):
    return await reach(scheduler, store, operation, lambda record: record.stage != "")


def ended_build(store, name, parameters=None, **policy):
    """The record of a build that has ended."""

    async def scenario():
        async with scheduling_on(store, **policy) as scheduler:
            operation = await scheduler.submit(begin(store, name, parameters))
            return await ended(scheduler, store, operation)

    return asyncio.run(scenario())


def error_of(record):
    return error_from_status(status_pb2.Status.FromString(record.error))


def metadata_of(record):
    return operations_pb2.OperationMetadata.FromString(record.metadata)


def test_a_build_that_works_makes_its_version_active(store):
    record = ended_build(store, "build_nothing")
    assert record.state is OperationState.SUCCEEDED
    version = store.maps.version("house", record.version)
    assert version.state is VersionState.ACTIVE
    assert store.maps.map_file(version) == b"map"


def test_an_error_of_the_work_ends_the_build_at_once(store, tmp_path):
    record = ended_build(store, "refuse", "walk")
    assert record.state is OperationState.FAILED
    assert error_of(record).reason == "NO_EVENTS"
    assert metadata_of(record).attempt_count == 1
    assert store.maps.version("house", record.version).state is VersionState.FAILED


def test_a_worker_that_is_always_lost_is_lost_after_three_attempts(store):
    record = ended_build(store, "lose_worker", 99)
    assert error_of(record).reason == "WORKER_LOST"
    assert metadata_of(record).attempt_count == 3


def test_the_attempt_after_a_lost_worker_counts(store, tmp_path):
    record = ended_build(store, "lose_worker_once", str(tmp_path / "lost"))
    assert record.state is OperationState.SUCCEEDED
    assert metadata_of(record).attempt_count == 2


def test_the_same_fault_twice_is_poison(store, caplog):
    record = ended_build(store, "fail")
    assert error_of(record).reason == "POISONED"
    assert error_of(record).found.split()[-1] in caplog.text
    assert "ZeroDivisionError" in caplog.text
    assert "ZeroDivisionError" not in str(error_of(record))


def test_different_faults_end_as_what_the_last_one_was(store, tmp_path):
    record = ended_build(store, "fail_differently", str(tmp_path / "count"))
    assert error_of(record).reason == "INTERNAL"
    assert metadata_of(record).attempt_count == 3


def test_work_that_needs_more_memory_gets_it_while_there_is_any(store):
    record = ended_build(store, "run_out_of_memory", memory_bytes=1 << 30, max_memory_bytes=2 << 30)
    assert error_of(record).reason == "TASK_OUT_OF_MEMORY"
    assert metadata_of(record).attempt_count == 2


def test_a_result_that_is_no_map_is_a_logged_fault(store, caplog):
    record = ended_build(store, "double", 21)
    assert error_of(record).found.split()[-1] in caplog.text
    assert "AttributeError" in caplog.text


def test_progress_says_what_each_stage_did_and_how_long_the_rest_takes(store):
    metadata = metadata_of(ended_build(store, "advance_slowly"))
    assert [(stage.name, stage.done_count) for stage in metadata.stages] == [
        ("first", 1),
        ("second", 2),
    ]
    assert metadata.HasField("time_left_s")


def test_a_first_result_can_be_used_while_the_build_goes_on(store):
    async def scenario():
        async with scheduling_on(store) as scheduler:
            operation = await scheduler.submit(begin(store, "preview_then_wait"))
            await at_work(scheduler, store, operation)
            preview = store.maps.version("house", operation.version)
            await scheduler.cancel(operation.id)
            return preview

    preview = asyncio.run(scenario())
    assert preview.state is VersionState.PREVIEW
    assert store.maps.map_file(preview) == b"map"
    assert store.maps.version("house", preview.version).state is VersionState.FAILED


def test_the_queue_is_bounded_and_waits_its_turn(store):
    async def scenario():
        async with scheduling_on(store) as scheduler:
            first = await scheduler.submit(begin(store, "wait"))
            await at_work(scheduler, store, first)
            second = await scheduler.submit(begin(store, "build_nothing"))
            with pytest.raises(LimitError) as caught:
                await scheduler.submit(begin(store, "build_nothing"))
            assert caught.value.reason == "QUEUE_FULL"
            assert store.operations.get(second.id).state is OperationState.QUEUED
            await scheduler.cancel(first.id)
            record = await ended(scheduler, store, second)
            third = await scheduler.submit(begin(store, "build_nothing"))
            await ended(scheduler, store, third)
            return record

    assert asyncio.run(scenario()).state is OperationState.SUCCEEDED


@pytest.mark.parametrize("is_queued", [False, True])
def test_a_cancelled_build_is_cancelled_when_cancel_returns(store, is_queued):
    async def scenario():
        async with scheduling_on(store) as scheduler:
            first = await scheduler.submit(begin(store, "wait"))
            await at_work(scheduler, store, first)
            second = await scheduler.submit(begin(store, "wait"))
            chosen = second if is_queued else first
            await scheduler.cancel(chosen.id)
            record = store.operations.get(chosen.id)
            await scheduler.cancel(chosen.id)
            return record

    record = asyncio.run(scenario())
    assert record.state is OperationState.CANCELLED
    assert store.operations.get(record.id) == record


def test_a_draining_scheduler_takes_no_more(store):
    async def scenario():
        async with scheduling_on(store) as scheduler:
            await scheduler.drain()
            with pytest.raises(UnavailableError) as caught:
                await scheduler.submit(begin(store, "build_nothing"))
            return caught.value.reason

    assert asyncio.run(scenario()) == "DRAINING"


def test_the_next_server_continues_what_a_draining_one_gave_back(store, tmp_path):
    flag = tmp_path / "flag"

    async def scenario():
        async with scheduling_on(store) as scheduler:
            operation = await scheduler.submit(begin(store, "wait_for", str(flag)))
            await at_work(scheduler, store, operation)
        assert store.operations.get(operation.id).state is OperationState.QUEUED
        flag.touch()
        async with scheduling_on(store) as scheduler:
            return await ended(scheduler, store, operation)

    record = asyncio.run(scenario())
    assert record.state is OperationState.SUCCEEDED
    # What was given back was no attempt.
    assert metadata_of(record).attempt_count == 1


@pytest.mark.parametrize(("death_count", "state"), [(1, "succeeded"), (3, "failed")])
def test_a_server_continues_what_dead_ones_left_behind_three_times(store, death_count, state):
    operation = begin(store, "build_nothing")()
    for _ in range(death_count):
        store.tasks.expire_leases()
        assert store.tasks.lease("a server that died") is not None

    async def scenario():
        async with scheduling_on(store) as scheduler:
            return await ended(scheduler, store, operation)

    record = asyncio.run(scenario())
    assert record.state.value == state
    if record.error:
        assert error_of(record).reason == "WORKER_LOST"


def test_an_operation_without_a_task_fails_as_lost(store):
    operation = begin(store, "build_nothing")()
    with store._database.write() as connection:
        connection.exec_driver_sql("DELETE FROM task")

    async def scenario():
        async with scheduling_on(store):
            return store.operations.get(operation.id)

    record = asyncio.run(scenario())
    assert record.state is OperationState.FAILED
    assert error_of(record).reason == "WORKER_LOST"


def test_an_attempt_whose_task_somebody_else_took_ends_without_a_say(store, monkeypatch):
    monkeypatch.setattr(scheduling, "RENEWAL_INTERVAL_S", 0.05)

    async def scenario():
        async with scheduling_on(store) as scheduler:
            operation = await scheduler.submit(begin(store, "wait"))
            await at_work(scheduler, store, operation)
            (_, attempt) = next(iter(scheduler._attempts.values()))
            store.tasks.expire_leases()
            taken = store.tasks.lease("another server")
            await asyncio.wait_for(asyncio.wait({attempt}), 30)
            return taken, store.operations.get(operation.id)

    taken, record = asyncio.run(scenario())
    assert taken.attempt_count == 2
    assert record.state is OperationState.RUNNING


def test_a_build_that_cannot_begin_leaves_its_place_free(store):
    async def scenario():
        async with scheduling_on(store, unfinished_count=1) as scheduler:
            with pytest.raises(NotFoundError):
                await scheduler.submit(lambda: store.builds.begin("elsewhere", "walk"))
            operation = await scheduler.submit(begin(store, "build_nothing"))
            return await ended(scheduler, store, operation)

    assert asyncio.run(scenario()).state is OperationState.SUCCEEDED


def test_a_scheduler_survives_a_store_that_fails_for_a_while(store, monkeypatch, caplog):
    lease, failures = store.tasks.lease, iter([OSError("disk full")])

    def lease_or_fail(owner):
        for error in failures:
            raise error
        return lease(owner)

    monkeypatch.setattr(store.tasks, "lease", lease_or_fail)
    assert ended_build(store, "build_nothing").state is OperationState.SUCCEEDED
    assert "disk full" in caplog.text


def test_time_to_wait_is_added_to_the_limit():
    policy = Policy(unfinished_count=1, time_s=10.0)
    task = TaskRecord(
        id="t",
        operation_id="o",
        state=TaskState.LEASED,
        parameters=b"",
        inputs=[],
        attempt_count=1,
        memory_doublings=1,
        failure_hash="",
        not_before_us=0,
        lease_owner="me",
        lease_until_us=0,
        fence=1,
    )
    limits = policy.limits(task, extra_s=5.0)
    assert (limits.time_s, limits.memory_bytes) == (15.0, policy.max_memory_bytes)
