import dataclasses
import sqlite3
from contextlib import closing

import pytest

from roel_service.errors import ConflictError, NotFoundError, StateError
from roel_service.progress import Progress
from roel_service.store.builds import BuiltVersion
from roel_service.store.records import OperationState, VersionState

from .samples import finalized, leased

BUILT = BuiltVersion(rlm_bytes=b"map", line_count=3, bounds_m=[0.0] * 6, report={})


@pytest.fixture
def begin(store):
    """Begins a build."""
    finalized(store)
    store.maps.create("house")
    return lambda: store.builds.begin("house", "walk")


@pytest.fixture
def operations(store):
    return store.operations


def test_progress_is_recorded_and_counted(store, begin, operations):
    operation = begin()
    progress = Progress(stage="refine", done_count=2, total_count=8, fraction=0.75)
    record = operations.advance(leased(store, operation), progress)
    assert record.state is OperationState.RUNNING
    assert (record.stage, record.done_count, record.total_count) == ("refine", 2, 8)
    assert record.fraction == 0.75
    assert record.update_seq == operation.update_seq + 1
    assert operations.get(operation.id) == record


LATE = Progress(stage="trim", done_count=0, total_count=0, fraction=0.9)
AGAIN = {"not_before_us": 0, "attempt_count": 1, "memory_doublings": 1, "failure_hash": "f"}

ENDS = {
    "advance": lambda operations, lease: operations.advance(lease, LATE),
    "preview": lambda operations, lease: operations.preview(lease, BUILT),
    "requeue": lambda operations, lease: operations.requeue(lease, **AGAIN),
    "succeed": lambda operations, lease: operations.succeed(lease, BUILT),
    "fail": lambda operations, lease: operations.fail(lease, b"late"),
}


@pytest.mark.parametrize("late", ENDS)
@pytest.mark.parametrize("first", ["cancel", "succeed", "lease", "requeue"])
def test_an_attempt_that_does_not_count_any_more_changes_nothing(
    store, begin, operations, late, first
):
    operation = begin()
    lease = leased(store, operation)
    if first == "cancel":
        operations.cancel(operation.id)
    elif first == "lease":
        store.tasks.expire_leases()
        leased(store, operation)
    else:
        ENDS[first](operations, lease)
    before = operations.get(operation.id), store.maps.version("house", 1)
    with pytest.raises(ConflictError) as caught:
        ENDS[late](operations, lease)
    assert caught.value.reason == "LEASE_LOST"
    assert (operations.get(operation.id), store.maps.version("house", 1)) == before


def test_the_first_end_is_the_last(begin, operations):
    operation = begin()
    ended = operations.cancel(operation.id)
    assert operations.cancel(operation.id) == ended
    assert operations.abandon(operation.id, b"late") == ended


def test_a_preview_can_be_used_until_the_last_result_takes_its_place(store, begin, operations):
    lease = leased(store, begin())
    operations.preview(lease, BUILT)
    assert store.maps.version("house", 1).state is VersionState.PREVIEW
    assert store.maps.map_file(store.maps.version("house", 1)) == b"map"
    operations.succeed(lease, dataclasses.replace(BUILT, rlm_bytes=b"refined"))
    assert store.maps.version("house", 1).state is VersionState.ACTIVE
    assert store.maps.map_file(store.maps.version("house", 1)) == b"refined"


def test_unfinished_builds_are_those_without_an_end(store, begin, operations):
    running = begin()
    lease = leased(store, running)
    queued, ended = begin(), begin()
    operations.advance(lease, LATE)
    operations.cancel(ended.id)
    assert {item.id for item in operations.unfinished()} == {queued.id, running.id}
    assert operations.without_task() == []


def test_pages_follow_the_order_of_ids(begin, operations):
    ids = sorted(begin().id for _ in range(3))
    assert [item.id for item in operations.page("", 2)] == ids[:2]
    assert [item.id for item in operations.page(ids[1], 2)] == ids[2:]


def test_only_an_operation_that_has_ended_can_be_deleted(store, begin, operations):
    operation = begin()
    with pytest.raises(StateError) as caught:
        operations.delete(operation.id)
    assert caught.value.reason == "OPERATION_RUNNING"
    operations.succeed(leased(store, operation), BUILT)
    operations.delete(operation.id)
    with pytest.raises(NotFoundError):
        operations.get(operation.id)
    assert store.maps.version("house", 1).state is VersionState.ACTIVE


def test_an_ended_operation_is_forgotten_when_it_expires(begin, operations, folder):
    running, ended, expired = (begin() for _ in range(3))
    for operation in (ended, expired):
        assert operations.cancel(operation.id).expire_time_us > operation.create_time_us
    with closing(sqlite3.connect(folder / "rows.sqlite")) as connection, connection:
        connection.execute("UPDATE operation SET expire_time_us = 1 WHERE id = ?", [expired.id])
    operations.delete_expired()
    assert {item.id for item in operations.page("", 10)} == {running.id, ended.id}
