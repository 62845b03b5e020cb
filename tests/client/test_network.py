"""Clients and servers with a network between them that drops and delays."""

import pytest

from roel_client import Client

from ..service.processes import CAMERA, config_of, events_of, new_id, trajectory_of
from ..service.sample_builds import QUICK
from .proxy import proxied

# 400,000 events are four chunks, more than a megabyte in all.
CUTS_BYTES = (100_000, 250_000, 300_000)


def test_an_upload_outlives_a_network_that_drops(server, client):
    events = events_of(400_000)
    stream, whole = (client.create_event_stream(new_id(), CAMERA) for _ in range(2))
    with (
        proxied(server.port, cuts_bytes=CUTS_BYTES) as (proxy, address),
        Client(address) as unlucky,
    ):
        record = unlucky.upload_events(stream, events)
        assert (proxy.cut_count, proxy.connection_count) == (len(CUTS_BYTES), len(CUTS_BYTES) + 1)
    client.upload_events(whole, events)
    assert record.event_count == 400_000
    assert client.finalize(stream).digest == client.finalize(whole).digest


@pytest.mark.parametrize("cut_bytes", [0, 20, 100])
def test_a_single_call_is_repeated_when_its_connection_is_cut(server, cut_bytes):
    with (
        proxied(server.port, cuts_bytes=[cut_bytes]) as (proxy, address),
        Client(address) as unlucky,
    ):
        assert unlucky.capabilities().version
        assert proxy.cut_count == 1


def test_a_slow_network_changes_nothing_but_the_time(server, client):
    inputs = events_of(1000), trajectory_of(5), CAMERA, config_of(QUICK)
    with proxied(server.port, delay_s=0.01) as (_, address), Client(address) as far:
        assert far.map_recording(*inputs)[0] == client.map_recording(*inputs)[0]
