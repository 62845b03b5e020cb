import pytest

from roel_client.retry import (
    NO_RETRY,
    Attempts,
    RetryPolicy,
    identified,
    is_repeatable,
    may_pass,
)
from roel_service.errors import ConflictError, LimitError, StateError, UnavailableError
from roel_service.v1 import events_pb2, maps_pb2
from roel_service.v1 import operations_pb2 as roel_operations_pb2

POLICY = RetryPolicy(attempt_count=4, first_pause_s=1.0, longest_pause_s=3.0)


class Clock:
    """A clock that stands still until it is moved."""

    now_s = 0.0

    def __call__(self):
        return self.now_s


def lost(retry_after_s=None):
    error = UnavailableError("server", "an answer", "none")
    error.retry_after_s = retry_after_s
    return error


def busy(retry_after_s):
    error = LimitError("build", "room", "none", reason="QUEUE_FULL")
    error.retry_after_s = retry_after_s
    return error


def test_pauses_grow_and_are_never_the_same_for_all():
    attempts = Attempts(POLICY)
    for longest_s in (1.0, 2.0, 3.0):
        assert longest_s / 2 <= attempts.pause_s(lost()) <= longest_s
    with pytest.raises(UnavailableError):
        attempts.pause_s(lost())


def test_the_server_may_ask_for_a_longer_pause():
    assert Attempts(POLICY).pause_s(busy(7.0)) == 7.0
    assert Attempts(POLICY).pause_s(lost(7.0)) == 7.0


def test_a_pause_that_would_outlast_the_timeout_is_not_taken():
    clock = Clock()
    attempts = Attempts(POLICY, timeout_s=10.0, clock=clock)
    clock.now_s = 4.0
    assert attempts.remaining_s() == 6.0
    with pytest.raises(LimitError):
        attempts.pause_s(busy(6.0))
    assert attempts.pause_s(busy(5.0)) == 5.0


@pytest.mark.parametrize(
    "error",
    [
        busy(None),
        ConflictError("chunk 3", "the bytes that were stored", "other bytes"),
        StateError("walk", "an open recording", "a frozen one"),
    ],
)
def test_what_waiting_does_not_cure_is_the_last_word(error):
    assert not may_pass(error)
    with pytest.raises(type(error)) as caught:
        Attempts(POLICY).pause_s(error)
    assert caught.value is error


@pytest.mark.parametrize("attempts", [Attempts(NO_RETRY), Attempts(POLICY, repeatable=False)])
def test_what_may_happen_once_happens_once(attempts):
    with pytest.raises(UnavailableError):
        attempts.pause_s(lost())


@pytest.mark.parametrize(
    "request_type",
    [
        events_pb2.GetEventStreamRequest,
        events_pb2.FinalizeEventStreamRequest,
        maps_pb2.ListMapsRequest,
        roel_operations_pb2.WatchOperationRequest,
    ],
)
def test_a_call_that_changes_nothing_twice_may_be_repeated(request_type):
    assert is_repeatable(request_type())


def test_a_call_without_a_request_id_is_not_repeated():
    assert not is_repeatable(events_pb2.DeleteEventStreamRequest())
    assert identified(events_pb2.GetEventStreamRequest()) == events_pb2.GetEventStreamRequest()
