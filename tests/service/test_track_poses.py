"""A camera that a server follows: the same poses as in process, and what ends a call."""

import asyncio
import threading

import numpy as np
import pytest

from roel_client import AsyncClient, Client
from roel_client.connection import Connection, Endpoint
from roel_service.config.stages import TrackConfig
from roel_service.errors import (
    ConfigError,
    EventsError,
    InputError,
    LimitError,
    NoAnswerError,
    NotFoundError,
    StateError,
)
from roel_service.geometry.se3 import SE3, rotation_from_vector
from roel_service.scene.lines import LineMap
from roel_service.scene.results import PoseStatus
from roel_service.tracking.tracker import PoseTracker
from roel_service.v1 import events_pb2, localization_pb2, localization_pb2_grpc
from roel_service.wire.chunks import encode_chunk
from roel_service.wire.provenance import Provenance
from roel_service.wire.rlm import decode_map, encode_map
from roel_service.wire.tracking import guess_to_proto, tracking_setup

from ..tracking.synthetic import CAMERA, recording
from .processes import Server

CONFIG = TrackConfig(max_event_count=4000)


@pytest.fixture(scope="module")
def room():
    return recording(seconds=0.5)


@pytest.fixture(scope="module")
def first(room):
    return room.pose(25_000)


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    running = Server(tmp_path_factory.mktemp("server") / "data", tracked_cameras=1)
    yield running
    assert running.stop() == 0


@pytest.fixture(scope="module")
def client(server):
    with Client(server.address) as connected:
        yield connected


@pytest.fixture(scope="module")
def file(tmp_path_factory, room):
    path = tmp_path_factory.mktemp("map") / "map.rlm"
    path.write_bytes(encode_map(room.line_map, Provenance()))
    return path


@pytest.fixture(scope="module")
def version(client, file):
    return client.import_map(client.create_map("room"), file).wait().name


@pytest.fixture
def connection(server):
    connected = Connection(Endpoint(address=server.address))
    yield connected
    connected.close()


@pytest.fixture
def answers_of(connection):
    """Sends messages of a whole call; its answers, as they come."""

    def called(*requests):
        stub = localization_pb2_grpc.LocalizationServiceStub(connection.channel)
        messages = [localization_pb2.TrackPosesRequest(**request) for request in requests]
        return connection.stream(stub.TrackPoses, iter(messages))

    return called


@pytest.fixture
def followed(answers_of):
    """Sends messages of a whole call; its answers once it has ended."""
    return lambda *requests: list(answers_of(*requests))


def setup(version, first, camera=CAMERA):
    return {"setup": tracking_setup(version, camera, first, 0, CONFIG)}


def chunk(seq, events):
    return {"chunk": events_pb2.EventChunk(seq=seq, data=encode_chunk(events))}


def test_poses_are_those_of_the_library(client, version, room, first, file):
    tracker = PoseTracker(decode_map(file.read_bytes()).line_map, CAMERA, CONFIG, first)
    expected = [pose for part in room.chunks() for pose in tracker.push(part)]
    with client.tracking(version, CAMERA, first, config=CONFIG) as tracking:
        for part in room.chunks():
            tracking.send(part)
        tracking.finish()
        found = list(iter(tracking.receive, None))
    assert [pose.status for pose in found] == [pose.status for pose in expected]
    assert found[-1].status is PoseStatus.TRACKING
    assert found[0].T_world_camera is None
    for here, there in zip(expected, found, strict=True):
        assert (there.t_us, there.seen_share) == (here.t_us, here.seen_share)
        if here.T_world_camera is None:
            continue
        np.testing.assert_allclose(
            there.T_world_camera.matrix(), here.T_world_camera.matrix(), atol=1e-12
        )
        np.testing.assert_array_equal(there.covariance, here.covariance)


def test_poses_come_while_events_are_still_to_come(client, version, room, first):
    with client.tracking(version, CAMERA, first, config=CONFIG) as tracking:
        for part in room.chunks()[:4]:
            tracking.send(part)
        # It is looked for.
        assert tracking.receive().status is PoseStatus.LOST
        tracking.finish()
        while tracking.receive() is not None:
            pass


def test_a_call_that_is_left_makes_room_for_the_next(client, version, room, first):
    with client.tracking(version, CAMERA, first, config=CONFIG) as tracking:
        tracking.send(room.chunks()[0])
    with client.tracking(version, CAMERA, first, config=CONFIG) as tracking:
        tracking.finish()
        assert tracking.receive() is None


def test_a_caller_is_told_when_events_are_waited_for(connection, version, first):
    request = localization_pb2.TrackPosesRequest(**setup(version, first))
    said, is_told = threading.Event(), threading.Event()

    def requests():
        yield request
        said.set()
        # None of the events is there yet.
        is_told.wait(60)

    stub = localization_pb2_grpc.LocalizationServiceStub(connection.channel)
    call = stub.TrackPoses(requests(), timeout=60)
    assert said.wait(60)
    call.initial_metadata()
    assert call.is_active()
    is_told.set()
    assert list(call) == []


def test_poses_of_sound_chunks_come_before_the_error_of_a_broken_one(
    answers_of, version, room, first
):
    chunks = room.chunks()
    broken = {"chunk": events_pb2.EventChunk(seq=4, data=b"no events")}
    answers = answers_of(
        setup(version, first), *(chunk(seq, part) for seq, part in enumerate(chunks[:4])), broken
    )
    poses = []
    with pytest.raises(EventsError) as caught:
        poses.extend(answers)
    assert caught.value.reason == "CHUNK_MALFORMED"
    assert poses[-1].seq == 3


def test_a_guess_is_where_the_search_begins(followed, version, room, first):
    backwards = rotation_from_vector(np.array([0.0, np.pi, 0.0]))
    far_off = SE3(rotation=first.rotation @ backwards, translation=first.translation)
    chunks = room.chunks()
    answers = followed(
        setup(version, far_off),
        *(chunk(7 + index, part) for index, part in enumerate(chunks[:4])),
        {"guess": guess_to_proto(room.pose(125_000))},
        *(chunk(11 + index, part) for index, part in enumerate(chunks[4:])),
    )
    assert answers[0].status == localization_pb2.TrackPosesResponse.STATUS_LOST
    assert not answers[0].HasField("T_world_camera")
    assert answers[-1].HasField("T_world_camera")
    assert {answer.map_version for answer in answers} == {version}
    # The last chunk may complete no pose.
    assert sorted(answer.seq for answer in answers) == [answer.seq for answer in answers]
    assert 7 + len(chunks) - 2 <= answers[-1].seq < 7 + len(chunks)


def test_events_before_the_beginning_are_passed_over(client, version, room):
    begin_us = 100_000
    guess = room.pose(begin_us + 25_000)
    with client.tracking(version, CAMERA, guess, t_us=begin_us, config=CONFIG) as tracking:
        for part in room.chunks():
            tracking.send(part)
        tracking.finish()
        assert tracking.receive().t_us >= begin_us


def test_a_second_camera_finds_no_child(client, followed, version, room, first):
    with client.tracking(version, CAMERA, first, config=CONFIG) as tracking:
        for part in room.chunks()[:4]:
            tracking.send(part)
        assert tracking.receive() is not None
        with pytest.raises(LimitError) as caught:
            followed(setup(version, first))
        assert caught.value.reason == "QUEUE_FULL"
        tracking.finish()
        while tracking.receive() is not None:
            pass


def test_the_asynchronous_client_is_told_the_same(server, client, version, room, first):
    async def followed():
        async with (
            AsyncClient(server.address) as there,
            there.tracking(version, CAMERA, first, config=CONFIG) as tracking,
        ):
            for part in room.chunks():
                await tracking.send(part)
            await tracking.finish()
            poses = []
            while (pose := await tracking.receive()) is not None:
                poses.append((pose.t_us, pose.status))
            return poses

    with client.tracking(version, CAMERA, first, config=CONFIG) as tracking:
        for part in room.chunks():
            tracking.send(part)
        tracking.finish()
        expected = [(pose.t_us, pose.status) for pose in iter(tracking.receive, None)]
    assert asyncio.run(followed()) == expected


class TestRefusals:
    def test_chunks_out_of_order(self, followed, version, room, first):
        chunks = room.chunks()
        with pytest.raises(StateError) as caught:
            followed(setup(version, first), chunk(0, chunks[0]), chunk(2, chunks[1]))
        assert caught.value.reason == "SEQUENCE_GAP"

    def test_events_of_another_sensor(self, followed, version, room, first):
        other = type(CAMERA)(width=300, height=180, fx_px=170, fy_px=170, cx_px=150, cy_px=90)
        with pytest.raises(EventsError) as caught:
            followed(setup(version, first, other), chunk(0, room.chunks()[0]))
        assert caught.value.reason == "SENSOR_MISMATCH"

    def test_a_second_setup(self, followed, version, first):
        with pytest.raises(InputError) as caught:
            followed(setup(version, first), setup(version, first))
        assert caught.value.reason == "UPLOAD_ORDER"

    def test_no_setup_at_all(self, followed, room):
        with pytest.raises(InputError, match="where the camera is"):
            followed()
        with pytest.raises(InputError) as caught:
            followed(chunk(0, room.chunks()[0]))
        assert caught.value.reason == "UPLOAD_ORDER"

    def test_a_version_that_is_not_there(self, server, client, followed, first):
        nowhere = "projects/default/maps/nowhere/versions/latest"
        with pytest.raises(NotFoundError):
            followed(setup(nowhere, first))
        with (
            client.tracking(nowhere, CAMERA, first) as tracking,
            pytest.raises(NotFoundError),
        ):
            tracking.receive()

        async def received():
            async with (
                AsyncClient(server.address) as there,
                there.tracking(nowhere, CAMERA, first) as tracking,
            ):
                await tracking.receive()

        with pytest.raises(NotFoundError):
            asyncio.run(received())

    def test_an_unknown_preset(self, followed, version, first):
        request = setup(version, first)
        request["setup"].preset = "best"
        with pytest.raises(ConfigError):
            followed(request)

    def test_a_map_of_a_few_lines(self, client, followed, tmp_path, room, first):
        few = LineMap.from_segments(room.line_map.segments[:4])
        (tmp_path / "few.rlm").write_bytes(encode_map(few, Provenance()))
        version = client.import_map(client.create_map("few"), tmp_path / "few.rlm").wait().name
        with pytest.raises(NoAnswerError) as caught:
            followed(setup(version, first))
        assert caught.value.reason == "TOO_FEW_LINES"
