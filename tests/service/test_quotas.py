"""What a caller may have, through the edge of a server."""

import pytest

from roel_client import Client, RetryPolicy
from roel_service.errors import LimitError
from roel_service.store.principals import Role
from roel_service.store.quotas import Quota
from roel_service.store.store import opened_principals

from .processes import CAMERA, Server, config_of, events_of, new_id, ready_recording
from .sample_builds import SLOW_ONCE

ONCE = RetryPolicy(attempt_count=1)
STORED_BYTES = 10_000


@pytest.fixture(scope="module")
def tokens():
    return {}


@pytest.fixture(scope="module")
def limited(tmp_path_factory, tokens):
    """A server on which callers are limited in different things."""
    folder = tmp_path_factory.mktemp("limited") / "data"
    quotas = {
        "bytes": Quota(stored_bytes=STORED_BYTES),
        "recordings": Quota(event_streams=1),
        "builds": Quota(unfinished_operations=1),
        "free": Quota(),
    }
    with opened_principals(folder) as principals:
        for name, quota in quotas.items():
            tokens[name] = principals.create(name, Role.BUILDER, quota=quota)
    running = Server(folder)
    yield running
    assert running.stop() == 0


@pytest.fixture
def caller(limited, tokens):
    opened = []

    def connected(name):
        opened.append(Client(limited.address, token=tokens[name], retry=ONCE))
        return opened[-1]

    yield connected
    for client in opened:
        client.close()


def refused(reason):
    return pytest.raises(LimitError, check=lambda error: error.reason == reason)


def test_a_recording_beyond_the_quota_is_refused_and_another_caller_is_not(caller):
    client = caller("bytes")
    stream = client.create_event_stream(new_id(), CAMERA)
    with refused("QUOTA_STORAGE"):
        client.upload_events(stream, events_of(50_000))
    assert client.event_stream(stream).event_count == 0
    assert caller("free").upload_events(stream, events_of(100)).event_count == 100
    told = client.capabilities().quota
    assert (told.caller, told.event_stream_count, told.max_stored_bytes) == (
        "bytes",
        1,
        STORED_BYTES,
    )
    assert 0 < told.stored_bytes < STORED_BYTES
    assert not told.HasField("max_event_stream_count")


def test_a_blob_beyond_the_quota_is_refused_before_its_first_byte(caller, tmp_path):
    client = caller("bytes")
    before_bytes = client.capabilities().quota.stored_bytes
    file = tmp_path / "file"
    file.write_bytes(bytes(1000))
    client.upload_blob(file)
    assert client.capabilities().quota.stored_bytes == before_bytes + 1000
    file.write_bytes(bytes(STORED_BYTES))
    with refused("QUOTA_STORAGE"):
        client.upload_blob(file)


def test_one_recording_more_is_refused_until_one_is_deleted(caller):
    client = caller("recordings")
    stream = client.create_event_stream(new_id(), CAMERA)
    with refused("QUOTA_EVENT_STREAMS"):
        client.create_event_stream(new_id(), CAMERA)
    client.delete_event_stream(stream)
    client.create_event_stream(new_id(), CAMERA)


def test_one_build_more_is_refused_until_one_has_ended(caller):
    client = caller("builds")
    stream, house = ready_recording(client), client.create_map(new_id())
    operation = client.build_map(house, stream, config_of(SLOW_ONCE))
    with pytest.raises(LimitError) as caught:
        client.build_map(house, stream, config_of(SLOW_ONCE))
    assert (caught.value.reason, caught.value.retry_after_s) == ("QUOTA_CONCURRENT_BUILDS", 5.0)
    assert client.capabilities().quota.unfinished_operation_count == 1
    operation.cancel()
    client.build_map(house, stream, config_of(SLOW_ONCE)).cancel()
