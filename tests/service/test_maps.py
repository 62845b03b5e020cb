import pytest

from roel_service.errors import (
    ConfigError,
    ConflictError,
    CorruptionError,
    InputError,
    NoAnswerError,
    NotFoundError,
    StateError,
)
from roel_service.v1 import config_pb2, maps_pb2, maps_pb2_grpc
from roel_service.wire.results import report_from_proto
from roel_service.wire.rlm import decode_map

from .processes import CAMERA, config_of, events_of, new_id, ready_recording
from .sample_builds import NO_ANSWER, QUICK, SEGMENTS, SLOW

ACTIVE = maps_pb2.MapVersion.STATE_ACTIVE
FAILED = maps_pb2.MapVersion.STATE_FAILED


@pytest.fixture(scope="module")
def stream(client):
    return ready_recording(client)


@pytest.fixture(scope="module")
def built(client, stream):
    """The first version of a map, which tests may not delete."""
    return client.build_map(client.create_map(new_id()), stream, config_of(QUICK)).wait()


@pytest.fixture
def map_name(client):
    return client.create_map(new_id())


@pytest.fixture
def call(connection):
    """A single call of the service by its name."""
    stub = maps_pb2_grpc.MapServiceStub(connection.channel)
    return lambda method, request: connection.call(getattr(stub, method), request)


def test_a_new_map_has_no_version(client, call, map_name):
    record = call("GetMap", maps_pb2.GetMapRequest(name=map_name))
    assert (record.name, record.version_count) == (map_name, 0)
    with pytest.raises(NotFoundError):
        client.map_version(f"{map_name}/versions/latest")


def test_a_built_version_tells_what_it_is(client, built, stream):
    map_name = built.name.removesuffix("/versions/v1")
    assert map_name != built.name
    assert (built.state, built.line_count, built.event_stream) == (ACTIVE, 3, stream)
    assert (built.bounds.min_x_m, built.bounds.max_z_m) == (0.0, 17.0)
    report = report_from_proto(built.report)
    assert (report["frame_count"], report["event_count"]) == (5, 1000)
    assert report["config"]["runtime"]["seed"] == QUICK
    assert client.map_version(f"{map_name}/versions/latest") == built


def test_a_downloaded_map_holds_the_lines(client, built):
    data = client.download_map(built.name)
    assert len(data) == built.map.size_bytes
    # Half of the container's step of 1 mm.
    assert abs(decode_map(data).line_map.segments - SEGMENTS).max() <= 0.5e-3


def test_every_build_is_a_new_version_listed_in_order(client, call, map_name, stream):
    for seed in (QUICK, NO_ANSWER, QUICK):
        operation = client.build_map(map_name, stream, config_of(seed))
        if seed == NO_ANSWER:
            with pytest.raises(NoAnswerError, match="at least 3 lines, found 2") as caught:
                operation.wait()
            assert caught.value.reason == "TOO_FEW_LINES"
        else:
            operation.wait()
    request = maps_pb2.ListMapVersionsRequest(parent=map_name, page_size=2)
    first = call("ListMapVersions", request)
    request.page_token = first.next_page_token
    rest = call("ListMapVersions", request)
    other = maps_pb2.ListMapVersionsRequest(
        parent=client.create_map(new_id()), page_token=first.next_page_token
    )
    with pytest.raises(InputError) as other_list:
        call("ListMapVersions", other)
    assert other_list.value.reason == "PAGE_TOKEN_INVALID"
    versions = [*first.map_versions, *rest.map_versions]
    assert [item.state for item in versions] == [ACTIVE, FAILED, ACTIVE]
    assert [item.name[-2:] for item in versions] == ["v1", "v2", "v3"]
    with pytest.raises(StateError) as not_active:
        client.download_map(f"{map_name}/versions/v2")
    assert not_active.value.reason == "MAP_NOT_ACTIVE"


def test_present_fields_override_the_named_preset(client, call, map_name, stream):
    config = config_pb2.MappingConfig()
    config.frames.rate_hz = 12.5
    request = maps_pb2.BuildMapRequest(
        parent=map_name, event_stream=stream, preset="paper", config=config
    )
    operation = client.operation(call("BuildMap", request).name)
    report = report_from_proto(operation.wait().report)
    assert report["config"]["frames"]["rate_hz"] == 12.5
    assert report["config"]["plane_fit"]["method"] == "ransac"


def test_a_configuration_that_cannot_be_is_refused_at_once(call, map_name, stream):
    config = config_pb2.MappingConfig()
    config.frames.rate_hz = -1.0
    request = maps_pb2.BuildMapRequest(parent=map_name, event_stream=stream, config=config)
    with pytest.raises(ConfigError, match=r"frames\.rate_hz > 0 and <= 1000, found -1\.0"):
        call("BuildMap", request)
    with pytest.raises(ConfigError, match="preset"):
        call("BuildMap", maps_pb2.BuildMapRequest(parent=map_name, event_stream=stream, preset="x"))
    assert call("GetMap", maps_pb2.GetMapRequest(name=map_name)).version_count == 0


def test_a_client_cannot_make_the_server_open_a_file(call, map_name, stream):
    config = config_pb2.MappingConfig()
    config.match_global.checkpoint = "/etc/hostname"
    request = maps_pb2.BuildMapRequest(parent=map_name, event_stream=stream, config=config)
    with pytest.raises(ConfigError, match=r"checkpoint: expected none on a server.* /etc/hostname"):
        call("BuildMap", request)
    assert call("GetMap", maps_pb2.GetMapRequest(name=map_name)).version_count == 0


def test_only_a_frozen_recording_with_poses_can_be_mapped(client, map_name):
    config = config_of(QUICK)
    stream = client.create_event_stream(new_id(), CAMERA)
    client.upload_events(stream, events_of(10))
    with pytest.raises(StateError) as not_finalized:
        client.build_map(map_name, stream, config)
    client.finalize(stream)
    with pytest.raises(StateError) as no_poses:
        client.build_map(map_name, stream, config)
    with pytest.raises(NotFoundError):
        client.build_map(map_name, "projects/default/eventStreams/nowhere", config)
    assert not_finalized.value.reason == "STREAM_NOT_FINALIZED"
    assert no_poses.value.reason == "NO_POSES"


def test_a_map_whose_bytes_were_changed_is_not_sent(server, client, stream):
    version = client.build_map(client.create_map(new_id()), stream, config_of(QUICK)).wait()
    sha256 = version.map.sha256
    blob = server.folder / "blobs" / "sha256" / sha256[:2] / sha256[2:4] / sha256
    data = blob.read_bytes()
    blob.write_bytes(data[:-1])
    with pytest.raises(CorruptionError, match=sha256):
        client.download_map(version.name)
    blob.write_bytes(data)


def test_ids_are_checked_and_unique(client):
    map_id = new_id()
    client.create_map(map_id)
    with pytest.raises(ConflictError):
        client.create_map(map_id)
    with pytest.raises(InputError):
        client.create_map("../etc")


def test_maps_are_listed_and_deleted(client, call, map_name):
    listed = call("ListMaps", maps_pb2.ListMapsRequest(parent="projects/default"))
    assert map_name in [item.name for item in listed.maps]
    client.delete_map(map_name)
    with pytest.raises(NotFoundError):
        call("GetMap", maps_pb2.GetMapRequest(name=map_name))
    with pytest.raises(NotFoundError):
        client.delete_map(map_name)


def test_what_a_build_uses_cannot_be_deleted(client, map_name):
    stream = ready_recording(client)
    operation = client.build_map(map_name, stream, config_of(SLOW))
    try:
        with pytest.raises(StateError) as map_in_use:
            client.delete_map(map_name)
        with pytest.raises(StateError) as stream_in_use:
            client.delete_event_stream(stream)
    finally:
        operation.cancel()
    assert map_in_use.value.reason == "MAP_IN_USE"
    assert stream_in_use.value.reason == "STREAM_IN_USE"
    client.delete_event_stream(stream)
    client.delete_map(map_name)
