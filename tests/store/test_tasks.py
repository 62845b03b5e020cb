import pytest

from roel_service.store import tasks as leasing
from roel_service.store.records import TaskState

from .samples import finalized, leased


@pytest.fixture
def begin(store):
    """Begins a build."""
    finalized(store)
    store.maps.create("house")
    return lambda: store.builds.begin("house", "walk", parameters=b"how")


def test_a_lease_hands_out_the_oldest_task_with_its_parameters(store, begin):
    first, second = begin(), begin()
    task = store.tasks.lease("me")
    assert (task.operation_id, task.parameters, task.inputs) == (first.id, b"how", [])
    assert (task.state, task.attempt_count, task.fence) == (TaskState.LEASED, 1, 1)
    assert store.tasks.lease("me").operation_id == second.id
    assert store.tasks.lease("me") is None


def test_a_lease_that_ran_out_is_taken_over_with_a_higher_fence(store, begin, monkeypatch):
    begin()
    monkeypatch.setattr(leasing, "LEASE_US", 0)
    first, second = store.tasks.lease("me"), store.tasks.lease("you")
    assert second.id == first.id
    assert (second.fence, second.attempt_count) == (first.fence + 1, 2)


def test_renewing_keeps_the_leases_of_one_owner(store, begin, monkeypatch):
    begin(), begin()
    monkeypatch.setattr(leasing, "LEASE_US", 0)
    mine = store.tasks.lease("me")
    monkeypatch.setattr(leasing, "LEASE_US", 60_000_000)
    assert store.tasks.renew("me") == {mine.id}
    other = store.tasks.lease("you")
    assert other.id != mine.id
    assert store.tasks.renew("me") == {mine.id}


def test_a_task_waits_until_its_time(store, begin):
    operation = begin()
    again = {"attempt_count": 1, "memory_doublings": 1, "failure_hash": "f"}
    store.operations.requeue(leased(store, operation), not_before_us=1 << 60, **again)
    assert store.tasks.lease("me") is None
    with store._database.write() as connection:
        connection.exec_driver_sql("UPDATE task SET not_before_us = 0")
    task = store.tasks.lease("me")
    assert (task.memory_doublings, task.failure_hash, task.attempt_count) == (1, "f", 2)
