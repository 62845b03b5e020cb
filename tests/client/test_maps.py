"""What the client offers around maps that are there already."""

import numpy as np
import pytest

from roel_client import Client
from roel_service.errors import InputError, NotFoundError, StateError
from roel_service.io.events import write_events_hdf5
from roel_service.v1 import maps_pb2

from ..service.processes import CAMERA, config_of, events_of, new_id, ready_recording
from ..service.sample_builds import QUICK, SEGMENTS


@pytest.fixture(scope="module")
def versions(server):
    """Names of two versions of one map, whose lines are `SEGMENTS`."""
    with Client(server.address) as client:
        stream, map_name = ready_recording(client), client.create_map(new_id())
        return [client.build_map(map_name, stream, config_of(QUICK)).wait().name for _ in range(2)]


def map_of(version_name):
    return version_name.rpartition("/versions/")[0]


def test_an_alias_is_moved_forth_and_back_and_removed(client, versions):
    first, second = versions
    map_name = map_of(first)
    assert client.promote(second, "live").aliases["live"] == "v2"
    assert client.promote(first, "live").aliases["live"] == "v1"
    assert client.map_version(f"{map_name}/versions/live").name == first
    record = client.map(map_name)
    assert dict(record.aliases) == {"live": "v1", "latest": "v2"}
    assert dict(client.delete_alias(map_name, "live", etag=record.etag).aliases) == {"latest": "v2"}
    with pytest.raises(NotFoundError):
        client.delete_alias(map_name, "live")
    with pytest.raises(InputError):
        client.delete_alias(map_name, "latest")


def test_maps_and_versions_are_listed(client, versions):
    map_name = map_of(versions[0])
    assert [item.name for item in client.map_versions(map_name)] == versions
    gone = client.create_map(new_id())
    client.delete_map(gone)
    assert map_name in {item.name for item in client.maps()}
    assert gone not in {item.name for item in client.maps()}
    assert gone in {item.name for item in client.maps(show_deleted=True)}
    assert not client.undelete_map(gone).HasField("delete_time")
    assert gone in {item.name for item in client.maps()}


def test_what_people_call_a_map_is_changed(client):
    name = client.create_map(new_id())
    labelled = client.update_map(name, labels={"site": "1"})
    changed = client.update_map(name, display_name="Kitchen", etag=labelled.etag)
    assert (changed.display_name, dict(changed.labels)) == ("Kitchen", {"site": "1"})
    assert client.map(name) == changed


def test_recordings_and_operations_are_listed(client, versions):
    name = client.map_version(versions[0]).operation
    assert name in {item.name for item in client.operations()}
    stream = client.create_event_stream(new_id(), CAMERA, {"robot": "r2"})
    listed = {item.name: item for item in client.event_streams()}
    assert (dict(listed[stream].labels), len(listed[stream].uid)) == ({"robot": "r2"}, 32)


def test_a_deleted_version_comes_back_as_it_was(client, versions):
    _, second = versions
    before = client.map_version(second)
    deleted = client.delete_map_version(second)
    assert deleted.state == maps_pb2.MapVersion.STATE_DELETED
    assert client.undelete_map_version(second) == before == client.map_version(second)
    with pytest.raises(StateError) as caught:
        client.undelete_map_version(second)
    assert caught.value.reason == "MAP_NOT_DELETED"


def test_lines_of_a_region_arrive_as_lines(client, versions):
    (every,) = client.lines(versions[0])
    np.testing.assert_allclose(
        np.sort(every.segments, axis=1).sum(), np.sort(SEGMENTS, axis=1).sum(), atol=0.01
    )
    far = np.array([[100.0, 100.0, 100.0], [101.0, 101.0, 101.0]])
    (none,) = client.lines(versions[0], far)
    assert len(none) == 0
    (long,) = client.lines(versions[0], min_length_m=1e3)
    assert len(long) == 0


def test_a_version_is_written_to_a_file_and_imported_again(client, versions, tmp_path):
    path = tmp_path / "map.rlm"
    client.export_map(versions[0], path, "rlm")
    assert path.read_bytes() == client.download_map(versions[0])
    again = client.import_map(client.create_map(new_id()), path).wait()
    assert client.download_map(again.name) == path.read_bytes()
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(InputError):
        client.export_map(versions[0], path, "stl")


def test_a_file_of_events_becomes_a_recording(client, tmp_path):
    events = events_of(5000)
    path = tmp_path / "events.h5"
    write_events_hdf5(path, [events])
    stream = client.create_event_stream(new_id(), CAMERA)
    record = client.import_events(stream, path).wait()
    assert (record.name, record.event_count) == (stream, 5000)
    uploaded = client.create_event_stream(new_id(), CAMERA)
    client.upload_events(uploaded, events)
    assert client.finalize(stream).digest == client.finalize(uploaded).digest


def test_usage_grows_with_what_is_kept(client):
    before = client.capabilities().usage
    stream = client.create_event_stream(new_id(), CAMERA)
    record = client.upload_events(stream, events_of(1000))
    client.create_map(new_id())
    after = client.capabilities().usage
    assert after.event_stream_count == before.event_stream_count + 1
    assert after.event_stream_bytes == before.event_stream_bytes + record.size_bytes
    assert after.map_count == before.map_count + 1
    assert after.unfinished_operation_count == 0
