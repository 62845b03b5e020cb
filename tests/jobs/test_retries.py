import pytest

from roel_service.errors import EventsError, LimitError, UnavailableError
from roel_service.jobs.faults import FaultError
from roel_service.jobs.retries import MAX_ATTEMPT_COUNT, Retry, judge
from roel_service.store.records import TaskRecord, TaskState

LOST = UnavailableError("task", "a worker", "none", reason="WORKER_LOST")
SHORT = LimitError("task", "less", "more", reason="TASK_OUT_OF_MEMORY")
SLOW = LimitError("task", "sooner", "later", reason="TASK_TIME_LIMIT")
REFUSED = EventsError("events", "some", "none", reason="NO_EVENTS")


def task(attempt_count=1, memory_doublings=0, failure_hash=""):
    return TaskRecord(
        id="t",
        operation_id="o",
        state=TaskState.LEASED,
        parameters=b"",
        inputs=[],
        attempt_count=attempt_count,
        memory_doublings=memory_doublings,
        failure_hash=failure_hash,
        not_before_us=0,
        lease_owner="me",
        lease_until_us=0,
        fence=1,
    )


def verdict(error, max_memory_doublings=1, **changes):
    return judge(task(**changes), error, delay_s=1.0, max_memory_doublings=max_memory_doublings)


@pytest.mark.parametrize("error", [REFUSED, SLOW])
def test_an_answer_is_final(error):
    assert verdict(error) is error


@pytest.mark.parametrize("error", [LOST, FaultError("a bug", "hash"), SHORT])
def test_what_may_pass_is_tried_again_but_not_for_ever(error):
    assert isinstance(verdict(error), Retry)
    assert verdict(error, attempt_count=MAX_ATTEMPT_COUNT) is error


def test_delays_grow_and_differ():
    for attempt_count in (1, 2):
        delays = {verdict(LOST, attempt_count=attempt_count).delay_s for _ in range(20)}
        assert len(delays) > 1
        assert all(0.5 * attempt_count <= delay <= 1.5 * attempt_count for delay in delays)


def test_memory_doubles_as_often_as_allowed():
    assert verdict(SHORT).memory_doublings == 1
    assert verdict(SHORT, memory_doublings=1) is SHORT
    assert verdict(LOST, memory_doublings=1).memory_doublings == 1


def test_the_same_fault_twice_is_poison_and_another_one_is_not():
    assert verdict(FaultError("a bug", "one"), failure_hash="one").reason == "POISONED"
    assert verdict(FaultError("a bug", "two"), failure_hash="one").failure_hash == "two"
