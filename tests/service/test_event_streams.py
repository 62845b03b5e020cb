import dataclasses
import uuid
from contextlib import ExitStack

import cv2
import numpy as np
import pytest
from google.longrunning import operations_pb2, operations_pb2_grpc

from roel_service.errors import (
    CameraError,
    ConflictError,
    EventsError,
    InputError,
    LimitError,
    NotFoundError,
    RoelError,
    StateError,
    TrajectoryError,
)
from roel_service.scene.camera import Camera
from roel_service.v1 import events_pb2, events_pb2_grpc, types_pb2
from roel_service.wire.chunks import encode_chunk
from roel_service.wire.nouns import camera_to_proto, trajectory_to_proto

from .processes import CAMERA, events_of, new_id, ready_recording, trajectory_of

OPEN = events_pb2.EventStream.STATE_OPEN
FINALIZED = events_pb2.EventStream.STATE_FINALIZED


@pytest.fixture
def stream(client):
    return client.create_event_stream(new_id(), CAMERA)


@pytest.fixture(scope="module")
def stub(connection):
    return events_pb2_grpc.EventStreamServiceStub(connection.channel)


@pytest.fixture
def call(connection, stub):
    """A single call of the service by its name."""
    return lambda method, request: connection.call(getattr(stub, method), request)


@pytest.fixture
def upload(connection, stub):
    """A streaming call of the service by its name."""
    return lambda method, *requests: connection.upload(getattr(stub, method), requests)


@pytest.fixture
def append(connection, stub):
    """All answers of a call of AppendEvents."""
    return lambda *requests: list(connection.stream(stub.AppendEvents, iter(requests)))


def parts_of(events, count):
    """Consecutive streams of so many events."""
    for start in range(0, len(events), count):
        part = slice(start, start + count)
        columns = {name: getattr(events, name)[part] for name in ("t_us", "x", "y", "polarity")}
        yield dataclasses.replace(events, **columns)


@pytest.fixture
def writing(connection, stub):
    """Begins a call of AppendEvents on a recording, and reads its first answer."""
    with ExitStack() as calls:

        def begin(stream):
            exchange = calls.enter_context(connection.exchange(stub.AppendEvents))
            exchange.send(header(stream))
            return exchange, exchange.receive()

        yield begin


def header(stream):
    return events_pb2.AppendEventsRequest(event_stream=stream)


def chunk(seq, data):
    return events_pb2.AppendEventsRequest(chunk=events_pb2.EventChunk(seq=seq, data=data))


def pose_header(stream):
    return events_pb2.AppendPosesRequest(event_stream=stream)


def poses(trajectory):
    return events_pb2.AppendPosesRequest(poses=trajectory_to_proto(trajectory))


def test_a_new_recording_is_open_and_remembers_its_camera(client, stream):
    record = client.event_stream(stream)
    assert record.name == stream
    assert record.state == OPEN
    assert record.camera == camera_to_proto(CAMERA)
    assert record.create_time.seconds > 1_500_000_000


def test_uploaded_events_and_poses_are_counted(client, stream):
    events = events_of(200_000)
    record = client.upload_events(stream, events)
    assert (record.chunk_count, record.event_count) == (2, 200_000)
    assert (record.start_us, record.end_us) == (events.t_us[0], events.t_us[-1])
    assert client.upload_poses(stream, trajectory_of(9)).pose_count == 9


def test_finalizing_twice_gives_the_same_recording(client, stream):
    client.upload_events(stream, events_of(10))
    record = client.finalize(stream)
    assert record.state == FINALIZED
    assert len(record.digest) == 64
    assert client.finalize(stream) == record


def test_equal_events_give_equal_digests(client):
    first, second = (client.event_stream(ready_recording(client)) for _ in range(2))
    assert first.digest == second.digest


def test_a_deleted_recording_is_not_found(client, stream):
    client.delete_event_stream(stream)
    with pytest.raises(NotFoundError):
        client.event_stream(stream)
    with pytest.raises(NotFoundError):
        client.delete_event_stream(stream)


def test_pages_hold_every_recording_once(client, call):
    made = {client.create_event_stream(new_id(), CAMERA) for _ in range(5)}
    found, token = [], ""
    while True:
        request = events_pb2.ListEventStreamsRequest(
            parent="projects/default", page_size=2, page_token=token
        )
        page = call("ListEventStreams", request)
        assert len(page.event_streams) <= 2
        found += [item.name for item in page.event_streams]
        token = page.next_page_token
        if not token:
            break
    assert made <= set(found)
    assert found == sorted(set(found))


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"page_size": -1}, "PAGE_SIZE_INVALID"),
        ({"page_token": "x"}, "PAGE_TOKEN_INVALID"),
        ({"page_token": "WyJtYXBzIiwgImEiXQ=="}, "PAGE_TOKEN_INVALID"),
        ({"page_token": "é"}, "PAGE_TOKEN_INVALID"),
        ({"parent": "projects/other"}, "NOT_FOUND"),
    ],
)
def test_list_arguments_that_cannot_be_are_refused(call, fields, reason):
    request = events_pb2.ListEventStreamsRequest(**{"parent": "projects/default", **fields})
    with pytest.raises(RoelError) as caught:
        call("ListEventStreams", request)
    assert caught.value.reason == reason


def test_ids_and_cameras_are_checked(client, call):
    stream_id = new_id()
    client.create_event_stream(stream_id, CAMERA)
    with pytest.raises(ConflictError) as taken:
        client.create_event_stream(stream_id, CAMERA)
    assert taken.value.reason == "ALREADY_EXISTS"
    for bad in ("No", "\U0001f600" * 10_000):
        with pytest.raises(InputError) as named:
            client.create_event_stream(bad, CAMERA)
        assert named.value.reason == "ID_INVALID"
    request = events_pb2.CreateEventStreamRequest(
        parent="projects/default",
        event_stream_id=new_id(),
        event_stream=events_pb2.EventStream(camera=types_pb2.Camera(width=3)),
    )
    with pytest.raises(CameraError):
        call("CreateEventStream", request)


def test_events_of_another_sensor_are_refused(client, stream):
    other = Camera(width=65, height=48, fx_px=1.0, fy_px=1.0, cx_px=0.0, cy_px=0.0)
    with pytest.raises(EventsError, match="64x48 sensor, as the camera's, found 65x48") as caught:
        client.upload_events(stream, events_of(10, camera=other))
    assert caught.value.reason == "SENSOR_MISMATCH"


def changed(data, place):
    return data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :]


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda data: data[:-1], "CHUNK_MALFORMED"),
        (lambda data: changed(data, -1 + len(data)), "CHUNK_CRC_MISMATCH"),
        (lambda data: changed(data, 20), "CHUNK_CRC_MISMATCH"),
        (lambda data: b"", "CHUNK_MALFORMED"),
        (lambda data: b"not a chunk" * 10, "CHUNK_MALFORMED"),
    ],
)
def test_damaged_chunks_are_refused_and_leave_nothing(client, append, stream, damage, reason):
    data = damage(encode_chunk(events_of(100)))
    with pytest.raises(EventsError) as caught:
        append(header(stream), chunk(0, data))
    assert caught.value.reason == reason
    assert client.event_stream(stream).chunk_count == 0


def test_a_chunk_that_goes_back_in_time_is_refused(append, stream):
    data = encode_chunk(events_of(100))
    with pytest.raises(EventsError) as caught:
        append(header(stream), chunk(0, data), chunk(1, data))
    assert caught.value.reason == "EVENT_TIME_NOT_MONOTONE"


def test_gaps_and_conflicts_are_told_apart(client, append, stream):
    data = encode_chunk(events_of(100))
    with pytest.raises(StateError) as gap:
        append(header(stream), chunk(3, data))
    assert (gap.value.reason, gap.value.expected) == ("SEQUENCE_GAP", "0")
    append(header(stream), chunk(0, data))
    assert append(header(stream), chunk(0, data))[-1].committed_seq == 1
    with pytest.raises(ConflictError) as conflict:
        append(header(stream), chunk(0, encode_chunk(events_of(100, seed=1))))
    assert conflict.value.reason == "CHUNK_CONFLICT"


def test_an_upload_begins_with_the_name_of_its_recording(upload, stream, append):
    data = encode_chunk(events_of(100))
    for requests in ([], [chunk(0, data)], [header(stream), header(stream)]):
        with pytest.raises(InputError):
            append(*requests)
    with pytest.raises(InputError) as caught:
        upload("AppendPoses", poses(trajectory_of(3)))
    assert caught.value.reason == "UPLOAD_ORDER"
    with pytest.raises(NotFoundError):
        append(header("projects/default/eventStreams/nowhere"), chunk(0, data))


def test_a_recording_has_a_largest_size(client, stream):
    with pytest.raises(LimitError) as caught:
        client.upload_events(stream, events_of(400_000))
    assert caught.value.reason == "EVENT_STREAM_TOO_LARGE"


def test_a_message_has_a_largest_size(append, stream):
    with pytest.raises(LimitError):
        append(header(stream), chunk(0, b"x" * (5 << 20)))


def test_poses_are_checked(client, upload, stream):
    trajectory = trajectory_of(5)
    bad = trajectory_to_proto(trajectory)
    bad.rotation = np.zeros((5, 3, 3)).tobytes()
    with pytest.raises(TrajectoryError):
        upload("AppendPoses", pose_header(stream), events_pb2.AppendPosesRequest(poses=bad))
    with pytest.raises(TrajectoryError, match="at least one in every message"):
        upload("AppendPoses", pose_header(stream), events_pb2.AppendPosesRequest(poses={}))
    client.upload_poses(stream, trajectory)
    with pytest.raises(TrajectoryError, match="poses after 20000 us"):
        client.upload_poses(stream, trajectory)
    assert client.event_stream(stream).pose_count == 5


@pytest.mark.parametrize("count", [101, 100_000])
def test_there_are_only_so_many_poses(client, stream, count):
    with pytest.raises(LimitError) as caught:
        client.upload_poses(stream, trajectory_of(count))
    assert caught.value.reason == "TOO_MANY_POSES"


def test_a_finalized_recording_takes_nothing_more(client, append):
    stream = ready_recording(client)
    with pytest.raises(StateError) as events:
        append(header(stream), chunk(1, encode_chunk(events_of(3))))
    with pytest.raises(StateError) as late_poses:
        client.upload_poses(stream, trajectory_of(3))
    assert events.value.reason == late_poses.value.reason == "STREAM_FINALIZED"


def test_a_recording_needs_events(client, stream):
    with pytest.raises(EventsError) as caught:
        client.finalize(stream)
    assert caught.value.reason == "NO_EVENTS"


def test_the_first_answer_tells_what_is_durable(client, stream, writing):
    _, status = writing(stream)
    assert (status.committed_seq, status.credit_chunks) == (0, 16)
    client.upload_events(stream, events_of(200_000))
    _, status = writing(stream)
    assert status.committed_seq == 2


def test_asking_for_the_status_replaces_no_writer(call, stream, writing):
    writer, first = writing(stream)
    request = events_pb2.QueryAppendStatusRequest(name=stream)
    assert call("QueryAppendStatus", request) == first
    writer.send(chunk(0, encode_chunk(events_of(10))))
    status = writer.receive()
    assert status.committed_seq == 1
    assert call("QueryAppendStatus", request) == status


def test_a_chunk_is_acknowledged_without_another_one(stream, writing):
    """A slow source is not made to wait for its group to fill."""
    writer, _ = writing(stream)
    for seq, events in enumerate(parts_of(events_of(40), 10)):
        writer.send(chunk(seq, encode_chunk(events)))
        assert writer.receive().committed_seq == seq + 1


def test_a_second_writer_takes_over(stream, writing):
    chunks = [encode_chunk(events) for events in parts_of(events_of(30), 10)]
    first, _ = writing(stream)
    first.send(chunk(0, chunks[0]))
    first.receive()
    second, status = writing(stream)
    assert status.committed_seq == 1
    with pytest.raises(ConflictError) as caught:
        first.receive()
    assert caught.value.reason == "WRITER_REPLACED"
    second.send(chunk(1, chunks[1]))
    assert second.receive().committed_seq == 2


def test_answers_tell_how_good_the_recording_is(client, call, stream, append):
    client.upload_poses(stream, trajectory_of(81))  # covers 400 ms
    t_us = np.array([0, 100_000, 350_000, 800_000])
    events = dataclasses.replace(events_of(4), t_us=t_us)
    quality = append(header(stream), chunk(0, encode_chunk(events)))[-1].quality
    assert quality.event_rate_hz == pytest.approx(4 / 0.8)
    assert quality.pose_coverage == pytest.approx(0.5)
    assert quality.longest_gap_us == 450_000


def test_a_time_range_is_read_back(client, stream):
    events = events_of(200_000)
    client.upload_events(stream, events)
    whole = [part.t_us for part in client.read_events(stream)]
    assert len(whole) == 2
    np.testing.assert_array_equal(np.concatenate(whole), events.t_us)
    start_us, stop_us = int(events.t_us[120_000]), int(events.t_us[150_000])
    parts = list(client.read_events(stream, start_us, stop_us))
    wanted = events.between(start_us, stop_us)
    for name in ("t_us", "x", "y", "polarity"):
        found = np.concatenate([getattr(part, name) for part in parts])
        np.testing.assert_array_equal(found, getattr(wanted, name))
    client.finalize(stream)
    assert list(client.read_events(stream, int(events.t_us[-1]) + 1)) == []
    assert sum(len(part) for part in client.read_events(stream, stop_us=stop_us)) > 10_000


def test_chunks_come_back_as_they_were_sent(connection, stub, append, stream):
    chunks = [encode_chunk(events) for events in parts_of(events_of(300), 100)]
    append(header(stream), *(chunk(seq, data) for seq, data in enumerate(chunks)))
    request = events_pb2.ReadEventsRequest(name=stream)
    read = [answer.data for answer in connection.stream(stub.ReadEvents, request)]
    assert read == chunks


def test_a_preview_shows_where_events_were(client, call, stream):
    client.upload_events(stream, events_of(2000))
    png = client.preview_events(stream, 0, 500_000)
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert image.shape == (48, 64, 3)
    assert image.any()
    request = events_pb2.PreviewEventsRequest(name=stream, start_us=2_000_000, stop_us=3_000_000)
    answer = call("PreviewEvents", request)
    assert answer.event_count == 0
    assert answer.png.startswith(b"\x89PNG")


def test_the_same_request_id_opens_and_deletes_once(connection):
    stub = events_pb2_grpc.EventStreamServiceStub(connection.channel)
    stream_id = new_id()
    create = events_pb2.CreateEventStreamRequest(
        parent="projects/default",
        event_stream_id=stream_id,
        event_stream=events_pb2.EventStream(camera=camera_to_proto(CAMERA)),
        request_id=str(uuid.uuid4()),
    )
    opened = connection.call(stub.CreateEventStream, create)
    assert connection.call(stub.CreateEventStream, create) == opened
    delete = events_pb2.DeleteEventStreamRequest(name=opened.name, etag="stale")
    with pytest.raises(ConflictError) as caught:
        connection.call(stub.DeleteEventStream, delete)
    assert caught.value.reason == "ETAG_MISMATCH"
    delete = events_pb2.DeleteEventStreamRequest(
        name=opened.name, etag=opened.etag, request_id=str(uuid.uuid4())
    )
    for _ in range(2):
        connection.call(stub.DeleteEventStream, delete)


def test_a_file_is_imported(client, call, connection, stream, tmp_path):
    file = tmp_path / "events.txt"
    file.write_text("0.001 3 4 1\n0.002 5 6 0\n0.002 7 8 1\n")
    request = events_pb2.ImportEventStreamRequest(
        name=stream, blob=client.upload_blob(file), request_id=str(uuid.uuid4())
    )
    begun = call("ImportEventStream", request)
    assert call("ImportEventStream", request).name == begun.name
    operations = operations_pb2_grpc.OperationsStub(connection.channel)
    wait = operations_pb2.WaitOperationRequest(name=begun.name)
    done = connection.call(operations.WaitOperation, wait, timeout_s=60)
    record = events_pb2.EventStream()
    assert done.response.Unpack(record)
    assert (record.name, record.event_count, record.state) == (stream, 3, OPEN)
    (events,) = client.read_events(stream)
    assert events.t_us.tolist() == [1000, 2000, 2000]
    assert events.x.tolist() == [3, 5, 7]
    request.request_id = str(uuid.uuid4())
    with pytest.raises(StateError) as caught:
        call("ImportEventStream", request)
    assert caught.value.reason == "STREAM_NOT_EMPTY"
