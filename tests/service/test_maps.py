import uuid

import pytest

from roel_client import Client
from roel_client.connection import Connection, Endpoint
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
from roel_service.wire.configs import config_to_proto
from roel_service.wire.results import report_from_proto
from roel_service.wire.rlm import decode_map

from .processes import CAMERA, config_of, events_of, new_id, ready_recording, trajectory_of
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


def test_a_build_may_follow_a_recording_that_is_still_open(client, map_name):
    stream = client.create_event_stream(new_id(), CAMERA)
    operation = client.build_map(map_name, stream, config_of(QUICK), follow=True)
    client.upload_poses(stream, trajectory_of(5))
    client.upload_events(stream, events_of(10))
    with pytest.raises(StateError) as in_use:
        client.delete_event_stream(stream)
    client.finalize(stream)
    assert operation.wait().report.event_count == 10
    assert in_use.value.reason == "STREAM_IN_USE"


def test_a_map_whose_bytes_were_changed_is_not_sent(server, client, stream):
    version = client.build_map(client.create_map(new_id()), stream, config_of(QUICK)).wait()
    sha256 = version.map.sha256
    blob = server.folder / "blobs" / "sha256" / sha256[:2] / sha256[2:4] / sha256
    data = blob.read_bytes()
    blob.write_bytes(data[:-1])
    # The server says so, not the client, which compares digests too.
    with pytest.raises(CorruptionError, match=f"blob {sha256}"):
        client.download_map(version.name)
    blob.write_bytes(data)


def test_ids_are_checked_and_unique(client):
    map_id = new_id()
    client.create_map(map_id)
    with pytest.raises(ConflictError):
        client.create_map(map_id)
    with pytest.raises(InputError):
        client.create_map("../etc")


def listed(call, **fields):
    request = maps_pb2.ListMapsRequest(parent="projects/default", page_size=1000, **fields)
    return {item.name: item for item in call("ListMaps", request).maps}


def test_maps_are_listed_deleted_and_undeleted(client, call, map_name):
    assert map_name in listed(call)
    client.delete_map(map_name)
    assert map_name not in listed(call)
    deleted = listed(call, show_deleted=True)[map_name]
    assert deleted.purge_time.ToSeconds() - deleted.delete_time.ToSeconds() == 30 * 24 * 3600
    with pytest.raises(StateError) as caught:
        client.map_version(f"{map_name}/versions/latest")
    assert caught.value.reason == "MAP_DELETED"
    back = call("UndeleteMap", maps_pb2.UndeleteMapRequest(name=map_name, etag=deleted.etag))
    assert not back.HasField("delete_time")
    assert listed(call)[map_name] == back
    with pytest.raises(StateError) as caught:
        call("UndeleteMap", maps_pb2.UndeleteMapRequest(name=map_name))
    assert caught.value.reason == "MAP_NOT_DELETED"


def test_a_purged_map_is_gone(client, call, map_name):
    client.delete_map(map_name)
    client.delete_map(map_name, purge=True)
    with pytest.raises(NotFoundError):
        call("GetMap", maps_pb2.GetMapRequest(name=map_name))
    with pytest.raises(NotFoundError):
        client.delete_map(map_name)


def test_names_and_labels_are_given_and_changed(call):
    given = maps_pb2.Map(display_name="Kitchen", labels={"floor": "2"})
    request = maps_pb2.CreateMapRequest(parent="projects/default", map_id=new_id(), map=given)
    created = call("CreateMap", request)
    assert (created.display_name, dict(created.labels)) == ("Kitchen", {"floor": "2"})
    created.display_name, stale = "Old kitchen", created.etag
    del created.labels["floor"]
    changed = call(
        "UpdateMap", maps_pb2.UpdateMapRequest(map=created, update_mask={"paths": ["display_name"]})
    )
    assert (changed.display_name, dict(changed.labels)) == ("Old kitchen", {"floor": "2"})
    cleared = call(
        "UpdateMap", maps_pb2.UpdateMapRequest(map=changed, update_mask={"paths": ["labels"]})
    )
    assert dict(cleared.labels) == {"floor": "2"}
    changed.labels.clear()
    changed.etag = ""
    cleared = call(
        "UpdateMap", maps_pb2.UpdateMapRequest(map=changed, update_mask={"paths": ["labels"]})
    )
    assert not cleared.labels
    cleared.etag = stale
    with pytest.raises(ConflictError) as caught:
        call("UpdateMap", maps_pb2.UpdateMapRequest(map=cleared))
    assert caught.value.reason == "ETAG_MISMATCH"


@pytest.mark.parametrize(
    ("given", "mask", "subject"),
    [
        (maps_pb2.Map(display_name="x" * 201), [], "display_name"),
        (maps_pb2.Map(display_name="a\nb"), [], "display_name"),
        (maps_pb2.Map(labels={"Upper": "x"}), [], "labels"),
        (maps_pb2.Map(labels={"key": "x" * 64}), [], "labels.key"),
        (maps_pb2.Map(labels={f"k{i}": "" for i in range(65)}), [], "labels"),
        (maps_pb2.Map(), ["version_count"], "update_mask"),
    ],
)
def test_what_cannot_be_changed_is_refused(call, map_name, given, mask, subject):
    given.name = map_name
    request = maps_pb2.UpdateMapRequest(map=given, update_mask={"paths": mask})
    with pytest.raises(InputError) as caught:
        call("UpdateMap", request)
    assert caught.value.subject == subject


def test_a_version_is_found_by_any_of_its_aliases(client, call, map_name, stream):
    for _ in range(2):
        client.build_map(map_name, stream, config_of(QUICK)).wait()

    def promote(version, alias):
        name = f"{map_name}/versions/{version}"
        return call("PromoteMapVersion", maps_pb2.PromoteMapVersionRequest(name=name, alias=alias))

    assert dict(promote("v2", "live").aliases) == {"live": "v2", "latest": "v2"}
    assert dict(promote("v1", "live").aliases) == {"live": "v1", "latest": "v2"}
    assert client.map_version(f"{map_name}/versions/live").name == f"{map_name}/versions/v1"
    with pytest.raises(StateError) as caught:
        call(
            "DeleteMapVersion",
            maps_pb2.DeleteMapVersionRequest(name=f"{map_name}/versions/v1"),
        )
    assert caught.value.reason == "VERSION_HAS_ALIAS"
    deleted = call(
        "DeleteMapVersion", maps_pb2.DeleteMapVersionRequest(name=f"{map_name}/versions/v2")
    )
    assert deleted.state == maps_pb2.MapVersion.STATE_DELETED
    assert deleted.HasField("purge_time")
    assert client.map_version(f"{map_name}/versions/latest").name == f"{map_name}/versions/v1"
    with pytest.raises(InputError) as caught:
        promote("v1", "latest")
    assert caught.value.reason == "ID_INVALID"


def test_the_same_request_id_twice_changes_once(call):
    request = maps_pb2.CreateMapRequest(
        parent="projects/default", map_id=new_id(), request_id=str(uuid.uuid4())
    )
    first = call("CreateMap", request)
    assert call("CreateMap", request) == first
    request.map_id = new_id()
    with pytest.raises(InputError) as reused:
        call("CreateMap", request)
    assert reused.value.reason == "REQUEST_ID_REUSED"
    request.request_id = "not a uuid"
    with pytest.raises(InputError) as invalid:
        call("CreateMap", request)
    assert invalid.value.reason == "REQUEST_ID_INVALID"


def test_a_page_token_survives_a_restart_and_fits_its_list_alone(start_server):
    server = start_server()
    with Client(server.address) as client:
        names = sorted(client.create_map(new_id()) for _ in range(3))
        first = list_maps(server.address, page_size=2)
    assert server.stop() == 0
    server = start_server(port=server.port)
    rest = list_maps(server.address, page_size=2, page_token=first.next_page_token)
    assert [item.name for item in (*first.maps, *rest.maps)] == names
    assert rest.next_page_token == ""
    with pytest.raises(InputError) as caught:
        list_maps(server.address, page_token=first.next_page_token, show_deleted=True)
    assert caught.value.reason == "PAGE_TOKEN_INVALID"


def list_maps(address, **fields):
    connection = Connection(Endpoint(address=address))
    stub = maps_pb2_grpc.MapServiceStub(connection.channel)
    try:
        request = maps_pb2.ListMapsRequest(parent="projects/default", **fields)
        return connection.call(stub.ListMaps, request)
    finally:
        connection.close()


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


def test_validating_a_build_changes_nothing(client, call, map_name, stream):
    request = maps_pb2.BuildMapRequest(parent=map_name, event_stream=stream, validate_only=True)
    operation = call("BuildMap", request)
    version = maps_pb2.MapVersion()
    assert (operation.name, operation.done) == ("", True)
    assert operation.response.Unpack(version)
    assert (version.name, version.event_stream) == (f"{map_name}/versions/v1", stream)
    assert call("GetMap", maps_pb2.GetMapRequest(name=map_name)).version_count == 0
    open_stream = client.create_event_stream(new_id(), CAMERA)
    request = maps_pb2.BuildMapRequest(
        parent=map_name, event_stream=open_stream, validate_only=True
    )
    with pytest.raises(StateError) as caught:
        call("BuildMap", request)
    assert caught.value.reason == "STREAM_NOT_FINALIZED"


def test_the_same_build_twice_is_one_operation(client, call, map_name, stream):
    request = maps_pb2.BuildMapRequest(
        parent=map_name,
        event_stream=stream,
        config=config_to_proto(config_of(SLOW)),
        request_id=str(uuid.uuid4()),
    )
    first = call("BuildMap", request)
    try:
        # A full queue refuses what is new, not what it holds.
        waiting = client.build_map(client.create_map(new_id()), stream, config_of(SLOW))
        assert call("BuildMap", request).name == first.name
        waiting.cancel()
        request.preset = "paper"
        with pytest.raises(InputError) as caught:
            call("BuildMap", request)
        assert caught.value.reason == "REQUEST_ID_REUSED"
    finally:
        client.operation(first.name).cancel()
    assert call("GetMap", maps_pb2.GetMapRequest(name=map_name)).version_count == 1


def test_operations_of_a_deleted_map_can_still_be_asked_for(client, map_name, stream):
    operation = client.build_map(map_name, stream, config_of(QUICK))
    version = operation.wait()
    client.delete_map(map_name)
    assert client.operation(operation.name).wait() == version
