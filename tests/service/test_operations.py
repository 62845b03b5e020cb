import contextlib
import os
import signal

import pytest
from google.longrunning import operations_pb2, operations_pb2_grpc
from google.protobuf.duration_pb2 import Duration
from google.rpc import code_pb2

from roel_service.errors import (
    Cancelled,
    InputError,
    LimitError,
    NotFoundError,
    RoelError,
    StateError,
    UnavailableError,
)
from roel_service.scene.results import MAPPING_STAGES
from roel_service.v1 import maps_pb2
from roel_service.v1 import operations_pb2 as roel_operations_pb2
from roel_service.v1 import operations_pb2_grpc as roel_operations_pb2_grpc

from .processes import config_of, new_id, ready_recording, wait_until
from .sample_builds import BUG, DIE, NO_ANSWER, QUICK, SLOW, SLOW_ONCE

NOWHERE = "operations/" + "0" * 32


@pytest.fixture(scope="module")
def stream(client):
    return ready_recording(client)


@pytest.fixture
def begin(client, server, stream):
    """Starts a build; slow ones are at work when this returns, and end with the test."""
    begun = []

    def started(seed):
        server.pid_file.unlink(missing_ok=True)
        begun.append(client.build_map(client.create_map(new_id()), stream, config_of(seed)))
        if seed in (SLOW, SLOW_ONCE) and len(begun) == 1:
            server.child_pid()
        return begun[-1]

    yield started
    for operation in begun:
        with contextlib.suppress(NotFoundError):
            operation.cancel()


@pytest.fixture(scope="module")
def ended(client, stream):
    """An operation that was waited for, the version it built, and the stages it went through."""
    stages = []
    operation = client.build_map(client.create_map(new_id()), stream, config_of(QUICK))
    version = operation.wait(lambda progress: stages.append(progress.stage))
    return operation, version, stages


@pytest.fixture
def call(connection):
    """A single call of `google.longrunning.Operations` by its name."""
    stub = operations_pb2_grpc.OperationsStub(connection.channel)

    def called(method, **fields):
        request = getattr(operations_pb2, f"{method}Request")(**fields)
        return connection.call(getattr(stub, method), request, timeout_s=60.0)

    return called


@pytest.fixture
def watch(connection):
    """All answers of a watch."""
    stub = roel_operations_pb2_grpc.OperationServiceStub(connection.channel)

    def watched(**fields):
        request = roel_operations_pb2.WatchOperationRequest(**fields)
        return list(connection.stream(stub.WatchOperation, request))

    return watched


def metadata_of(message):
    metadata = roel_operations_pb2.OperationMetadata()
    assert message.metadata.Unpack(metadata)
    return metadata


def test_waiting_tells_the_stages_in_order_and_gives_the_version(ended):
    _, version, stages = ended
    assert version.line_count == 3
    # The watcher may join late and may miss what changed in between, but never goes back.
    order = ["", *MAPPING_STAGES]
    assert [order.index(stage) for stage in stages] == sorted(map(order.index, stages))


def test_an_ended_operation_answers_with_its_version(ended, call):
    operation, version, _ = ended
    for method in ("GetOperation", "WaitOperation"):
        message = call(method, name=operation.name)
        answered = maps_pb2.MapVersion()
        assert message.done
        assert message.response.Unpack(answered)
        assert answered == version
    metadata = metadata_of(message)
    assert (metadata.target, metadata.method) == (version.name, "BuildMap")
    assert metadata.end_time.ToMicroseconds() >= metadata.create_time.ToMicroseconds()


def test_a_watch_continues_after_the_last_change_that_was_seen(ended, watch):
    operation, _, _ = ended
    whole = watch(name=operation.name)
    last = whole[-1].update_seq
    rest = watch(name=operation.name, update_seq=last)
    assert [(answer.update_seq, answer.operation.done) for answer in rest] == [(last, True)]
    assert rest[0] == whole[-1]


def test_cancelling_what_has_ended_changes_nothing(ended, call):
    operation, _, _ = ended
    operation.cancel()
    assert call("GetOperation", name=operation.name).HasField("response")


def test_a_running_operation_tells_how_far_it_is(begin, call):
    operation = begin(SLOW)
    wait_until(lambda: metadata_of(call("GetOperation", name=operation.name)).stage)
    metadata = metadata_of(call("GetOperation", name=operation.name))
    assert (metadata.stage, metadata.done_count, metadata.total_count) == ("detect", 1, 9)
    assert not metadata.HasField("end_time")


def test_waiting_has_a_timeout(begin, call):
    timeout = Duration(nanos=100_000_000)
    assert not call("WaitOperation", name=begin(SLOW).name, timeout=timeout).done


def test_waiting_ends_with_the_operation(begin, call):
    code = code_pb2.FAILED_PRECONDITION
    assert call("WaitOperation", name=begin(NO_ANSWER).name).error.code == code


def test_cancelling_ends_the_child_and_the_operation(server, begin, call):
    operation = begin(SLOW)
    child = server.child_pid()
    operation.cancel()
    assert call("GetOperation", name=operation.name).error.code == code_pb2.CANCELLED
    with pytest.raises(ProcessLookupError):
        os.kill(child, 0)
    with pytest.raises(Cancelled):
        operation.wait()


def test_an_interrupted_wait_cancels_the_build(begin, call):
    operation = begin(SLOW)

    def interrupt(progress):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        operation.wait(interrupt)
    assert call("GetOperation", name=operation.name).error.code == code_pb2.CANCELLED


def test_a_killed_child_is_replaced_and_the_build_goes_on(server, begin):
    operation = begin(SLOW_ONCE)
    os.kill(server.child_pid(), signal.SIGKILL)
    assert operation.wait().line_count == 3


def test_a_build_whose_children_are_all_killed_fails_and_the_server_lives(begin):
    with pytest.raises(UnavailableError, match="SIGKILL") as caught:
        begin(DIE).wait()
    assert caught.value.reason == "WORKER_LOST"
    assert begin(QUICK).wait().line_count == 3


def test_a_bug_in_a_build_is_told_without_its_traceback(server, begin):
    with pytest.raises(RoelError) as caught:
        begin(BUG).wait()
    assert caught.value.reason == "POISONED"
    assert "ZeroDivisionError" not in str(caught.value)
    assert "ZeroDivisionError: a bug" in server.log


def test_the_queue_is_bounded(begin):
    begin(SLOW)
    begin(SLOW)
    with pytest.raises(LimitError) as caught:
        begin(SLOW)
    assert caught.value.reason == "QUEUE_FULL"


def test_operations_are_listed_page_by_page(ended, begin, call):
    names = {ended[0].name, begin(SLOW).name}
    found, token = [], ""
    while True:
        page = call("ListOperations", name="operations", page_size=1, page_token=token)
        found += [item.name for item in page.operations]
        token = page.next_page_token
        if not token:
            break
    assert names <= set(found)
    assert len(found) == len(set(found))


def test_only_an_ended_operation_can_be_deleted(begin, call):
    operation = begin(SLOW)
    with pytest.raises(StateError) as caught:
        call("DeleteOperation", name=operation.name)
    assert caught.value.reason == "OPERATION_RUNNING"
    operation.cancel()
    call("DeleteOperation", name=operation.name)
    with pytest.raises(NotFoundError):
        call("GetOperation", name=operation.name)


@pytest.mark.parametrize(
    "method", ["GetOperation", "CancelOperation", "DeleteOperation", "WaitOperation"]
)
@pytest.mark.parametrize(("name", "kind"), [(NOWHERE, NotFoundError), ("nonsense", InputError)])
def test_other_operations_are_not_found(call, method, name, kind):
    with pytest.raises(kind):
        call(method, name=name)


def test_watching_another_operation_is_refused(watch):
    with pytest.raises(NotFoundError):
        watch(name=NOWHERE)
