"""What an operator sees of a server: metrics, probes, log lines."""

import asyncio
import http.client
import json
import re

import grpc
import pytest

from roel_client import Client
from roel_client.connection import Connection, Endpoint
from roel_service.errors import LimitError, NotFoundError
from roel_service.service.calls import Call
from roel_service.service.observe import Metrics, Observation
from roel_service.v1 import localization_pb2, maps_pb2, maps_pb2_grpc, registration_pb2

from .processes import Server, config_of, new_id, ready_recording
from .sample_builds import QUICK, SLOW_ONCE


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    folder = tmp_path_factory.mktemp("server") / "data"
    running = Server(folder, listen={"admin": ["127.0.0.1", 0]})
    yield running
    assert running.stop() == 0


@pytest.fixture(scope="module")
def get(server):
    """Status, type and text of a page of the admin address."""

    def got(path, method="GET"):
        connection = http.client.HTTPConnection(server.admin, timeout=10)
        connection.request(method, path)
        answer = connection.getresponse()
        text = answer.read().decode()
        connection.close()
        return answer.status, answer.getheader("Content-Type"), text

    return got


@pytest.fixture
def sample(get):
    """Value of a metric by its name and labels as they are shown; 0 if it is not there."""

    def sampled(shown):
        _, _, text = get("/metrics")
        found = re.search(rf"^{re.escape(shown)} (.*)$", text, re.MULTILINE)
        return float(found[1]) if found else 0.0

    return sampled


@pytest.fixture
def log_lines(server):
    """Lines of the log about calls."""

    def lines():
        parsed = (json.loads(line) for line in server.log.splitlines() if line.startswith("{"))
        return [line for line in parsed if line["message"] == "call"]

    return lines


GET_MAP = "/roel_service.v1.MapService/GetMap"


def test_calls_are_counted_by_method_and_code(server, sample):
    shown = f'roel_rpc_handled_total{{method="{GET_MAP}",code="NOT_FOUND"}}'
    before = sample(shown)
    with Client(server.address) as client, pytest.raises(NotFoundError):
        client._connection.call(
            client._maps.GetMap, maps_pb2.GetMapRequest(name="projects/default/maps/nowhere")
        )
    assert sample(shown) == before + 1
    count = f'roel_rpc_seconds_count{{method="{GET_MAP}",code="NOT_FOUND"}}'
    assert sample(count) == sample(shown)


def test_bytes_are_counted(server, sample):
    append = "/roel_service.v1.EventStreamService/AppendEvents"
    shown = f'roel_rpc_received_bytes_total{{method="{append}"}}'
    before = sample(shown)
    with Client(server.address) as client:
        name = ready_recording(client, 1000)
        size = client.event_stream(name).size_bytes
    assert sample(shown) > before + size


def test_unfinished_operations_are_shown_by_state(sample):
    assert sample('roel_operations{state="running"}') == 0
    assert sample("roel_process_peak_memory_bytes") > 10_000_000


def test_operations_that_ended_are_counted_with_their_stages(server, sample):
    with Client(server.address) as client:
        stream = ready_recording(client)
        client.build_map(client.create_map(new_id()), stream, config_of(QUICK)).wait()
    assert sample('roel_operations_ended_total{method="BuildMap",state="succeeded"}') >= 1
    assert sample('roel_operation_attempts_total{method="BuildMap"}') >= 1
    assert sample('roel_stage_units_total{stage="detect",cached="no"}') >= 1
    assert sample('roel_stage_seconds_sum{stage="detect"}') >= 0.25


def test_the_oldest_operation_is_told(server, sample):
    with Client(server.address) as client:
        stream = ready_recording(client)
        operation = client.build_map(client.create_map(new_id()), stream, config_of(SLOW_ONCE))
        states = ("queued", "running")
        ages_s = [sample(f'roel_oldest_operation_seconds{{state="{state}"}}') for state in states]
        assert max(ages_s) > 0
        operation.cancel()
    assert sample('roel_oldest_operation_seconds{state="running"}') == 0


def test_verdicts_are_taken_from_answers():
    call = Call(method="Localize")
    response = localization_pb2.LocalizeResponse
    call.see_response(response(status=response.STATUS_AMBIGUOUS))
    assert call.verdict == "STATUS_AMBIGUOUS"
    call.see_response(registration_pb2.RegisterResponse(verdict=1))
    assert call.verdict == "VERDICT_ACCEPTED"


def test_verdicts_are_counted():
    metrics = Metrics(store=None)

    async def main():
        async with Observation(metrics)(call := Call(method="Localize")):
            call.verdict = "STATUS_FOUND"

    asyncio.run(main())
    shown = 'roel_verdicts_total{method="Localize",verdict="STATUS_FOUND"} 1'
    assert shown in "\n".join(metrics.verdicts.lines())


def test_probes_answer(get):
    assert get("/livez") == (200, "text/plain; charset=utf-8", "ok\n")
    assert get("/readyz")[0] == 200
    assert get("/elsewhere")[0] == 404
    assert get("/metrics", "POST")[0] == 405


def test_every_call_leaves_a_line(server, log_lines):
    with Client(server.address) as client:
        stream = ready_recording(client)
        operation = client.build_map(client.create_map(new_id()), stream, config_of(QUICK))
        operation.wait()
    ends = {line["method"].rpartition("/")[2]: line for line in log_lines()}
    assert ends["FinalizeEventStream"]["resource"] == stream
    assert ends["BuildMap"]["operation"] == operation.name
    assert ends["BuildMap"]["principal"] == "local"
    assert ends["AppendEvents"]["received_bytes"] > 1000
    assert {len(line["request_id"]) for line in ends.values()} == {32}


def test_the_caller_may_name_the_request(server, log_lines):
    connection = Connection(Endpoint(address=server.address))
    stub = maps_pb2_grpc.MapServiceStub(connection.channel)
    with pytest.raises(grpc.RpcError) as caught:
        stub.GetMap(maps_pb2.GetMapRequest(name="x"), metadata=(("x-request-id", "mine-1"),))
    connection.close()
    assert log_lines()[-1]["request_id"] == "mine-1"
    details = dict(caught.value.trailing_metadata())["grpc-status-details-bin"]
    assert b"mine-1" in details


def test_a_message_that_grpc_would_inflate_is_refused(server):
    with grpc.insecure_channel(server.address, compression=grpc.Compression.Gzip) as channel:
        stub = maps_pb2_grpc.MapServiceStub(channel)
        with pytest.raises(grpc.RpcError) as caught:
            stub.GetMap(maps_pb2.GetMapRequest(name="x" * 10_000), timeout=10)
    assert caught.value.code() is grpc.StatusCode.UNIMPLEMENTED


def test_a_message_beyond_the_limit_is_refused(server):
    with Client(server.address) as client, pytest.raises(LimitError) as caught:
        client.map_version("x" * 5_000_000)
    assert caught.value.reason == "MESSAGE_TOO_LARGE"


def test_calls_that_are_given_up_do_no_harm(server):
    """A context that is asked after its call was cancelled would end the server at once."""
    connection = Connection(Endpoint(address=server.address))
    stub = maps_pb2_grpc.MapServiceStub(connection.channel)
    request = maps_pb2.GetMapRequest(name="projects/default/maps/nowhere")
    for _ in range(20):
        for call in [stub.GetMap.future(request) for _ in range(20)]:
            call.cancel()
    with pytest.raises(NotFoundError):
        connection.call(stub.GetMap, request)
    connection.close()
