import json

import pytest
from google.longrunning import operations_pb2

from roel_client import retry
from roel_client.retry import IDEMPOTENT_METHODS, PAUSES_S, resumed, service_config
from roel_service.errors import ConflictError, UnavailableError
from roel_service.v1 import capabilities_pb2, events_pb2, maps_pb2

FILES = (capabilities_pb2, events_pb2, maps_pb2, operations_pb2)


@pytest.fixture
def pauses(monkeypatch):
    """Pauses that are noted instead of waited for."""
    slept = []
    monkeypatch.setattr(retry.time, "sleep", slept.append)
    return slept


def lost():
    return UnavailableError("server", "an answer", "none")


def test_only_single_calls_that_exist_are_repeated():
    services = {
        service.full_name: service
        for file in FILES
        for service in file.DESCRIPTOR.services_by_name.values()
    }
    for name, methods in IDEMPOTENT_METHODS.items():
        for method in methods:
            described = services[name].methods_by_name[method]
            assert not described.client_streaming
            assert not described.server_streaming


def test_only_unavailable_is_repeated():
    (method,) = json.loads(service_config())["methodConfig"]
    assert method["retryPolicy"]["retryableStatusCodes"] == ["UNAVAILABLE"]
    named = {item["method"] for item in method["name"]}
    assert not named & {"CreateMap", "CreateEventStream", "BuildMap", "DeleteMap"}


def test_a_call_is_resumed_until_it_succeeds(pauses):
    answers = iter([lost(), lost(), "done"])

    def call():
        answer = next(answers)
        if isinstance(answer, UnavailableError):
            raise answer
        return answer

    assert resumed(call) == "done"
    assert len(pauses) == 2
    for pause_s, longest_s in zip(pauses, PAUSES_S, strict=False):
        assert longest_s / 2 <= pause_s <= longest_s


def test_resuming_ends_with_the_last_pause(pauses):
    calls = []

    def call():
        calls.append(1)
        raise lost()

    with pytest.raises(UnavailableError):
        resumed(call)
    assert len(calls) == len(PAUSES_S) + 1


def test_other_errors_are_raised_at_once(pauses):
    def call():
        raise ConflictError("chunk 3", "the bytes that were stored", "other bytes")

    with pytest.raises(ConflictError):
        resumed(call)
    assert pauses == []
