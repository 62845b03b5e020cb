import sqlite3
from contextlib import closing

import pytest

from roel_service.errors import NotFoundError, StateError
from roel_service.progress import Progress
from roel_service.store.builds import BuiltVersion
from roel_service.store.records import OperationState, VersionState

from .samples import finalized

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


def test_progress_is_recorded_and_counted(begin, operations):
    operation = begin()
    progress = Progress(stage="refine", done_count=2, total_count=8, fraction=0.75)
    record = operations.advance(operation.id, progress)
    assert record.state is OperationState.RUNNING
    assert (record.stage, record.done_count, record.total_count) == ("refine", 2, 8)
    assert record.fraction == 0.75
    assert record.update_seq == operation.update_seq + 1
    assert operations.get(operation.id) == record


def test_the_first_end_is_the_last(store, begin, operations):
    operation = begin()
    ended = operations.cancel(operation.id)
    late = Progress(stage="trim", done_count=0, total_count=0, fraction=0.9)
    assert operations.succeed(operation.id, BUILT) == ended
    assert operations.fail(operation.id, b"late") == ended
    assert operations.advance(operation.id, late) == ended
    assert store.maps.version("house", 1).state is VersionState.FAILED


def test_unfinished_builds_are_those_without_an_end(begin, operations):
    queued, running, ended = (begin() for _ in range(3))
    operations.advance(running.id, Progress(stage="", done_count=0, total_count=0, fraction=0.0))
    operations.cancel(ended.id)
    assert {item.id for item in operations.unfinished()} == {queued.id, running.id}


def test_pages_follow_the_order_of_ids(begin, operations):
    ids = sorted(begin().id for _ in range(3))
    assert [item.id for item in operations.page("", 2)] == ids[:2]
    assert [item.id for item in operations.page(ids[1], 2)] == ids[2:]


def test_only_an_operation_that_has_ended_can_be_deleted(store, begin, operations):
    operation = begin()
    with pytest.raises(StateError) as caught:
        operations.delete(operation.id)
    assert caught.value.reason == "OPERATION_RUNNING"
    operations.succeed(operation.id, BUILT)
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
