import asyncio

import pytest
from google.rpc import status_pb2

from roel_service.errors import LimitError, NotFoundError, UnavailableError
from roel_service.jobs.scheduler import Scheduler
from roel_service.jobs.task import TaskSpec
from roel_service.scene.camera import Camera
from roel_service.store.event_streams import Chunk, PosePart
from roel_service.store.records import OperationState, VersionState
from roel_service.store.store import Store
from roel_service.wire.errors import error_from_status

CAMERA = Camera(width=8, height=6, fx_px=5.0, fy_px=5.0, cx_px=4.0, cy_px=3.0)


@pytest.fixture
def store(tmp_path):
    with Store(tmp_path) as opened:
        opened.event_streams.create("walk", CAMERA)
        chunk = Chunk(seq=0, t0_us=0, t1_us=1, event_count=1, data=b"events")
        opened.event_streams.append_chunks("walk", [chunk], 100)
        poses = PosePart(t0_us=0, t1_us=1, pose_count=2, data=b"poses")
        opened.event_streams.append_poses("walk", poses, 100)
        opened.event_streams.finalize("walk")
        opened.maps.create("house")
        yield opened


def begin(store, name, parameters=None):
    def begun():
        operation = store.builds.begin("house", "walk")
        return operation, TaskSpec(entrypoint=f"sample_tasks:{name}", parameters=parameters)

    return begun


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


def error_of(record):
    return error_from_status(status_pb2.Status.FromString(record.error))


def test_a_build_that_works_makes_its_version_active(store):
    async def scenario():
        scheduler = Scheduler(store.operations, 1, 1)
        operation = await scheduler.submit(begin(store, "build_nothing"))
        return await ended(scheduler, store, operation)

    record = asyncio.run(scenario())
    assert record.state is OperationState.SUCCEEDED
    version = store.maps.version("house", record.version)
    assert version.state is VersionState.ACTIVE
    assert store.maps.map_file(version) == b"map"


@pytest.mark.parametrize(
    ("task", "reason"), [("refuse", "NO_EVENTS"), ("die", "WORKER_LOST"), ("fail", "INTERNAL")]
)
def test_a_build_that_fails_says_why(store, task, reason):
    async def scenario():
        scheduler = Scheduler(store.operations, 1, 1)
        operation = await scheduler.submit(begin(store, task, "walk"))
        return await ended(scheduler, store, operation)

    record = asyncio.run(scenario())
    assert record.state is OperationState.FAILED
    assert error_of(record).reason == reason
    assert store.maps.version("house", record.version).state is VersionState.FAILED


def test_a_result_that_is_no_map_is_a_logged_fault(store, caplog):
    async def scenario():
        scheduler = Scheduler(store.operations, 1, 1)
        operation = await scheduler.submit(begin(store, "double", 21))
        return await ended(scheduler, store, operation)

    record = asyncio.run(scenario())
    fault_id = error_of(record).found.split()[-1]
    assert fault_id in caplog.text
    assert "AttributeError" in caplog.text
    assert "AttributeError" not in str(error_of(record))


def test_the_queue_is_bounded_and_waits_its_turn(store):
    async def scenario():
        scheduler = Scheduler(store.operations, concurrent_count=1, queued_count=1)
        first = await scheduler.submit(begin(store, "sleep"))
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
        scheduler = Scheduler(store.operations, concurrent_count=1, queued_count=1)
        first = await scheduler.submit(begin(store, "sleep"))
        await at_work(scheduler, store, first)
        second = await scheduler.submit(begin(store, "sleep"))
        chosen = second if is_queued else first
        await scheduler.cancel(chosen.id)
        record = store.operations.get(chosen.id)
        await scheduler.cancel(chosen.id)
        await scheduler.drain()
        return record

    assert asyncio.run(scenario()).state is OperationState.CANCELLED


def test_a_draining_scheduler_fails_its_builds_and_takes_no_more(store):
    async def scenario():
        scheduler = Scheduler(store.operations, 1, 1)
        operation = await scheduler.submit(begin(store, "sleep"))
        await scheduler.drain()
        with pytest.raises(UnavailableError) as caught:
            await scheduler.submit(begin(store, "sleep"))
        assert caught.value.reason == "DRAINING"
        return store.operations.get(operation.id)

    assert error_of(asyncio.run(scenario())).reason == "DRAINING"


def test_a_build_that_cannot_begin_leaves_its_place_free(store):
    async def scenario():
        scheduler = Scheduler(store.operations, concurrent_count=1, queued_count=0)

        def missing():
            store.builds.begin("elsewhere", "walk")

        with pytest.raises(NotFoundError):
            await scheduler.submit(missing)
        operation = await scheduler.submit(begin(store, "build_nothing"))
        return await ended(scheduler, store, operation)

    assert asyncio.run(scenario()).state is OperationState.SUCCEEDED


def test_what_a_dead_server_left_behind_fails_as_lost(store):
    queued = store.builds.begin("house", "walk")
    asyncio.run(Scheduler(store.operations, 1, 1).fail_unfinished())
    record = store.operations.get(queued.id)
    assert record.state is OperationState.FAILED
    assert error_of(record).reason == "WORKER_LOST"
