import subprocess
import sys
import threading

import pytest

from roel_client import Client
from roel_client.connection import Connection, Endpoint
from roel_service.config.load import to_tables
from roel_service.errors import (
    Cancelled,
    EventsError,
    NoAnswerError,
    RoelError,
    UnavailableError,
)
from roel_service.progress import ignore
from roel_service.scene.results import MAPPING_STAGES
from roel_service.v1 import events_pb2, events_pb2_grpc, maps_pb2, maps_pb2_grpc
from roel_service.wire.rlm import decode_map

from ..service.processes import CAMERA, Server, config_of, events_of, new_id, trajectory_of
from ..service.sample_builds import BUG, NO_ANSWER, QUICK, SLOW, SLOW_ONCE

# Nothing listens on the discard port of loopback.
NOWHERE = "127.0.0.1:9"


def map_with(client, seed, progress=ignore, events=None):
    source = events or events_of(1000)
    return client.map_recording(source, trajectory_of(5), CAMERA, config_of(seed), progress)


@pytest.fixture
def kept(server):
    """Names of all that the server keeps."""
    connection = Connection(Endpoint(address=server.address))
    streams = events_pb2_grpc.EventStreamServiceStub(connection.channel)
    maps = maps_pb2_grpc.MapServiceStub(connection.channel)

    def listed():
        fields = {"parent": "projects/default"}
        requests = events_pb2.ListEventStreamsRequest(**fields), maps_pb2.ListMapsRequest(**fields)
        held_streams = connection.call(streams.ListEventStreams, requests[0]).event_streams
        held_maps = connection.call(maps.ListMaps, requests[1]).maps
        return [item.name for item in [*held_streams, *held_maps]]

    yield listed
    connection.close()


def test_a_recording_becomes_a_map_and_nothing_stays(client, kept):
    data, report = map_with(client, QUICK)
    assert len(decode_map(data).line_map) == report["line_count"] == 3
    assert report["event_count"] == 1000
    assert report["config"] == to_tables(config_of(QUICK))
    assert kept() == []


def test_progress_goes_from_the_upload_to_the_stages(client):
    told = []
    map_with(client, QUICK, told.append)
    stages = [progress.stage for progress in told]
    assert stages[0] == "upload"
    assert told[0].done_count == 1000
    assert set(stages) <= {"upload", "", *MAPPING_STAGES}
    assert [item.fraction for item in told] == sorted(item.fraction for item in told)


@pytest.mark.parametrize(
    ("seed", "kind", "reason"),
    [(NO_ANSWER, NoAnswerError, "TOO_FEW_LINES"), (BUG, RoelError, "POISONED")],
)
def test_what_goes_wrong_there_is_raised_here(client, kept, seed, kind, reason):
    with pytest.raises(RoelError) as caught:
        map_with(client, seed)
    assert type(caught.value) is kind
    assert caught.value.reason == reason
    assert kept() == []


@pytest.mark.parametrize("kind", [Cancelled, KeyboardInterrupt])
@pytest.mark.parametrize("stage", ["upload", "detect"])
def test_whoever_interrupts_leaves_nothing_behind(client, kept, kind, stage):
    def interrupt(progress):
        if progress.stage == stage:
            raise kind

    with pytest.raises(kind):
        map_with(client, SLOW, interrupt)
    assert kept() == []


def test_an_error_of_the_source_is_raised_as_it_is(client, kept):
    class Source:
        width, height = CAMERA.width, CAMERA.height

        def chunks(self):
            yield events_of(200_000)
            raise EventsError("walk.txt", "numbers", "x", reason="EVENTS_INVALID")

    with pytest.raises(EventsError, match=r"walk\.txt: expected numbers, found x"):
        map_with(client, QUICK, events=Source())
    assert kept() == []


@pytest.mark.parametrize("address", [NOWHERE, "nowhere.invalid:1"])
def test_a_server_that_is_not_there_is_named(address):
    with Client(address) as client:
        for call in (client.capabilities, lambda: map_with(client, QUICK)):
            with pytest.raises(UnavailableError, match=address):
                call()


def test_poses_of_many_messages_arrive_whole(client):
    stream = client.create_event_stream(new_id(), CAMERA)
    assert client.upload_poses(stream, trajectory_of(20_001)).pose_count == 20_001
    client.delete_event_stream(stream)


@pytest.mark.parametrize("end", [Server.kill, Server.stop])
def test_an_upload_continues_on_the_server_that_took_over(start_server, end):
    """The server ends while it receives; its successor gets only what it does not have."""
    first = start_server(commit_bytes=1)
    successors = []

    class Source:
        """After its first chunks the server is replaced by one on the same port and folder."""

        width, height = CAMERA.width, CAMERA.height

        def chunks(self):
            events = events_of(400_000)
            yield events
            if not successors:
                end(first)
                successors.append(start_server(port=first.port))

    with Client(first.address) as client:
        stream = client.create_event_stream("walk", CAMERA)
        record = client.upload_events(stream, Source())
        assert record.event_count == 400_000
        once = client.create_event_stream("once", CAMERA)
        client.upload_events(once, events_of(400_000))
        assert client.finalize(stream).digest == client.finalize(once).digest
    assert successors[0].stop() == 0


def test_a_watch_and_its_build_outlive_a_killed_server(start_server):
    first = start_server()
    at_work = threading.Event()
    with Client(first.address) as client:
        stream = client.create_event_stream("walk", CAMERA)
        client.upload_poses(stream, trajectory_of(5))
        client.upload_events(stream, events_of(10))
        client.finalize(stream)
        operation = client.build_map(client.create_map("house"), stream, config_of(SLOW_ONCE))
        outcome = []
        waiting = threading.Thread(
            target=lambda: outcome.append(operation.wait(lambda progress: at_work.set()))
        )
        waiting.start()
        at_work.wait()
        first.child_pid()
        first.kill()
        second = start_server(port=first.port)
        waiting.join()
    assert outcome[0].line_count == 3
    assert second.stop() == 0


def test_importing_the_client_loads_no_algorithm():
    heavy = ("torch", "open3d", "cv2", "numba")
    script = (
        "import sys; from roel_client import Client; print([m for m in %r if m in sys.modules])"
    )
    run = [sys.executable, "-c", script % (heavy,)]
    assert subprocess.run(run, capture_output=True, text=True, check=True).stdout == "[]\n"
