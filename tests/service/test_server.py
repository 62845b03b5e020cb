import asyncio
import json
import re
import resource
import signal
import subprocess
import sys
import threading
from pathlib import Path

import grpc
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha.proto_reflection_descriptor_database import (
    ProtoReflectionDescriptorDatabase,
)

from roel_client import AsyncClient, Client
from roel_client.connection import Connection, Endpoint
from roel_client.retry import NO_RETRY
from roel_service import __version__
from roel_service.errors import InputError, LimitError, RoelError, UnavailableError
from roel_service.scene.results import MAPPING_STAGES
from roel_service.service.listen import Listen
from roel_service.service.server import serve
from roel_service.service.services import SERVICES
from roel_service.v1 import events_pb2, events_pb2_grpc, maps_pb2
from roel_service.wire.chunks import encode_chunk, split_chunks

from .processes import CAMERA, config_of, events_of, new_id, ready_recording, wait_until
from .sample_builds import QUICK, SLOW_ONCE

HEAVY = ("torch", "open3d", "cv2", "numba", "llvmlite")


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "data"


def command(folder, *options):
    return [sys.executable, "-m", "roel_service.service", "--data", folder, *options]


def refused(*arguments):
    """What a server says that ends at once with code 2."""
    ended = subprocess.run(arguments, capture_output=True, text=True, timeout=60, check=False)
    assert (ended.returncode, ended.stdout) == (2, "")
    return ended.stderr


def test_capabilities_name_version_limits_presets_and_stages(client):
    answer = client.capabilities()
    assert answer.version == __version__
    assert tuple(answer.stages) == MAPPING_STAGES
    assert list(answer.presets) == ["default", "precise", "paper"]
    assert answer.limits.pose_count == 100
    assert answer.limits.events_per_chunk == 131_072
    assert all(value > 0 for _, value in answer.limits.ListFields())


@pytest.mark.parametrize("service", ["", *SERVICES])
def test_every_service_is_healthy(server, service):
    with grpc.insecure_channel(server.address) as channel:
        request = health_pb2.HealthCheckRequest(service=service)
        answer = health_pb2_grpc.HealthStub(channel).Check(request, timeout=10)
    assert answer.status == health_pb2.HealthCheckResponse.SERVING


def test_reflection_describes_every_service(server):
    with grpc.insecure_channel(server.address) as channel:
        database = ProtoReflectionDescriptorDatabase(channel)
        assert set(SERVICES) <= set(database.get_services())
        described = database.FindFileContainingSymbol("roel_service.v1.MapService")
    assert "BuildMap" in [method.name for method in described.service[0].method]


def test_a_running_front_holds_no_algorithm(server, client):
    client.build_map(client.create_map(new_id()), ready_recording(client), config_of(QUICK)).wait()
    mapped = Path(f"/proc/{server.process.pid}/maps").read_text()
    assert "_cython" in mapped, "the list of mapped libraries is not what this test expects"
    for name in HEAVY:
        assert f"/{name}" not in mapped


def test_importing_the_front_loads_no_algorithm():
    script = "import sys, roel_service.service.server; print([m for m in %r if m in sys.modules])"
    run = [sys.executable, "-c", script % (HEAVY,)]
    assert subprocess.run(run, capture_output=True, text=True, check=True).stdout == "[]\n"


def test_a_fault_is_told_by_its_id_alone(server, client):
    stream = client.create_event_stream(new_id(), CAMERA)
    for path in (server.folder / "recordings").iterdir():
        path.unlink()
    with pytest.raises(RoelError) as caught:
        client.upload_events(stream, events_of(10))
    assert type(caught.value) is RoelError
    fault_id = re.search(r"logged as ([0-9a-f]{12})$", str(caught.value))[1]
    assert str(server.folder) not in str(caught.value)
    assert f"fault {fault_id} in /roel_service.v1.EventStreamService/AppendEvents" in server.log
    assert "FileNotFoundError" in server.log


def test_a_full_disk_is_told_and_the_server_goes_on_when_there_is_room(start_server):
    server = start_server()
    with Client(server.address, retry=NO_RETRY) as client:
        client.create_map("before")
        kept = resource.prlimit(server.process.pid, resource.RLIMIT_FSIZE)
        resource.prlimit(server.process.pid, resource.RLIMIT_FSIZE, (1, kept[1]))
        with pytest.raises(UnavailableError) as caught:
            client.create_map("meanwhile")
        assert (caught.value.reason, caught.value.retry_after_s) == ("STORE_UNAVAILABLE", 5.0)
        resource.prlimit(server.process.pid, resource.RLIMIT_FSIZE, kept)
        client.create_map("after")
        assert [item.name for item in client.maps()] == [
            "projects/default/maps/after",
            "projects/default/maps/before",
        ]
    assert server.stop() == 0


def test_the_module_announces_its_address_and_ends_with_0(folder):
    with subprocess.Popen(command(folder, "--port", "0"), stdout=subprocess.PIPE) as process:
        address = json.loads(process.stdout.readline())["address"]
        with Client(address) as client:
            assert client.capabilities().version == __version__
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0


def test_calls_that_come_too_fast_are_dropped_unread_but_not_health_checks(start_server):
    server = start_server(calls_unseen=1)

    async def main():
        async with (
            AsyncClient(server.address, retry=NO_RETRY) as client,
            grpc.aio.insecure_channel(server.address) as channel,
        ):
            name = await client.create_map("house")
            calls = asyncio.gather(*(client.map(name) for _ in range(300)), return_exceptions=True)
            check = health_pb2_grpc.HealthStub(channel).Check
            for _ in range(10):
                await check(health_pb2.HealthCheckRequest(), timeout=30)
            return await calls

    answers = asyncio.run(main())
    dropped = [answer for answer in answers if isinstance(answer, LimitError)]
    assert 0 < len(dropped) < len(answers)
    assert {(error.reason, error.retry_after_s) for error in dropped} == {("QUEUE_FULL", 5.0)}
    assert all(isinstance(answer, maps_pb2.Map | LimitError) for answer in answers)


def test_a_folder_serves_one_server(server):
    assert "one in use" in refused(*command(server.folder, "--port", "0"))


def test_a_taken_port_is_told(server, folder):
    with pytest.raises(UnavailableError, match=f"{server.address}: expected a free address"):
        asyncio.run(serve(folder, Listen(port=server.port), on_ready=print))


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.0.2.1", "example.org"])
def test_only_loopback_is_served_without_encryption(folder, host):
    with pytest.raises(InputError, match="--host: expected a loopback address") as caught:
        asyncio.run(serve(folder, Listen(host=host, port=0), on_ready=print))
    assert caught.value.reason == "INSECURE_HOST"
    assert not folder.exists()


def test_another_host_is_served_when_that_is_wanted(folder):
    options = ["--host", "0.0.0.0", "--insecure", "--port", "0"]
    with subprocess.Popen(command(folder, *options), stdout=subprocess.PIPE) as process:
        assert json.loads(process.stdout.readline())["address"].startswith("0.0.0.0:")
        process.terminate()
        assert process.wait(30) == 0


def test_acknowledged_chunks_survive_a_killed_server(start_server):
    first = start_server(commit_bytes=1)
    chunks = [encode_chunk(events) for events in split_chunks(events_of(300_000))]
    with Client(first.address) as client:
        stream = client.create_event_stream("walk", CAMERA)
    connection = Connection(Endpoint(address=first.address))
    stub = events_pb2_grpc.EventStreamServiceStub(connection.channel)
    with connection.exchange(stub.AppendEvents) as exchange:
        exchange.send(events_pb2.AppendEventsRequest(event_stream=stream))
        for seq in range(2):
            chunk = events_pb2.EventChunk(seq=seq, data=chunks[seq])
            exchange.send(events_pb2.AppendEventsRequest(chunk=chunk))
        while exchange.receive().committed_seq < 2:
            pass
        first.kill()
        with pytest.raises(UnavailableError):
            exchange.receive()
    connection.close()
    second = start_server()
    with Client(second.address) as client:
        record = client.event_stream(stream)
        assert (record.chunk_count, record.event_count) == (2, 262_144)
        assert client.upload_events(stream, events_of(300_000)).event_count == 300_000
        client.finalize(stream)
    assert second.stop() == 0


def test_a_build_goes_on_after_its_server_was_killed(start_server):
    first = start_server()
    with Client(first.address) as client:
        map_name = client.create_map("house")
        name = client.build_map(map_name, ready_recording(client), config_of(SLOW_ONCE)).name
        child = first.child_pid()
        first.kill()
    second = start_server()
    with Client(second.address) as client:
        assert client.operation(name).wait().line_count == 3
    wait_until(lambda: not Path(f"/proc/{child}").exists())
    assert second.stop() == 0


def test_a_draining_server_gives_its_builds_back_and_answers_whoever_waits(start_server):
    server = start_server()
    with Client(server.address) as client:
        map_name = client.create_map("house")
        operation = client.build_map(map_name, ready_recording(client), config_of(SLOW_ONCE))
        child = server.child_pid()
        outcome = []

        def wait():
            try:
                outcome.append(operation.wait().line_count)
            except RoelError as error:
                outcome.append(error.reason)

        waiting = threading.Thread(target=wait)
        waiting.start()
        assert server.stop() == 0
        assert not Path(f"/proc/{child}").exists()
        assert "Traceback" not in server.log
        next_server = start_server(port=server.port)
        waiting.join()
    assert outcome == [3]
    assert next_server.stop() == 0
