"""The asynchronous client does what `test_client` shows of the synchronous one."""

import asyncio

import pytest

from roel_client import AsyncClient
from roel_service.errors import EventsError, RoelError, UnavailableError
from roel_service.wire.rlm import decode_map

from ..service.processes import CAMERA, config_of, events_of, new_id, trajectory_of
from ..service.sample_builds import BUG, QUICK, SLOW
from .test_client import NOWHERE


def run(address, work):
    """Result of `work(client)` in a loop of its own."""

    async def main():
        async with AsyncClient(address) as client:
            return await work(client)

    return asyncio.run(main())


def map_with(client, seed, events=None):
    source = events or events_of(1000)
    return client.map_recording(source, trajectory_of(5), CAMERA, config_of(seed))


def test_both_clients_build_equal_maps(server, client):
    data, report = run(server.address, lambda there: map_with(there, QUICK))
    same_data, same_report = map_with(client, QUICK)
    assert data == same_data
    assert len(decode_map(data).line_map) == 3
    assert report == same_report


def test_builds_run_side_by_side(server):
    async def both(client):
        return await asyncio.gather(map_with(client, QUICK), map_with(client, QUICK))

    (first, _), (second, _) = run(server.address, both)
    assert first == second


def test_what_goes_wrong_there_is_raised_here(server):
    with pytest.raises(RoelError) as caught:
        run(server.address, lambda client: map_with(client, BUG))
    assert caught.value.reason == "POISONED"


def test_an_error_of_the_source_is_raised_as_it_is(server):
    class Source:
        width, height = CAMERA.width, CAMERA.height

        def chunks(self):
            yield events_of(200_000)
            raise EventsError("walk.txt", "numbers", "x", reason="EVENTS_INVALID")

    with pytest.raises(EventsError, match=r"walk\.txt: expected numbers, found x"):
        run(server.address, lambda client: map_with(client, QUICK, Source()))


def test_an_upload_that_the_server_refuses_tells_why(server):
    async def to_nowhere(client):
        await client.upload_events(f"projects/default/eventStreams/{new_id()}", events_of(300_000))

    with pytest.raises(RoelError) as caught:
        run(server.address, to_nowhere)
    assert caught.value.reason == "NOT_FOUND"


def test_cancelling_the_task_cancels_the_build(server):
    server.pid_file.unlink(missing_ok=True)

    async def interrupt(client):
        stream = await client.create_event_stream(new_id(), CAMERA)
        await client.upload_poses(stream, trajectory_of(5))
        await client.upload_events(stream, events_of(10))
        await client.finalize(stream)
        operation = await client.build_map(
            await client.create_map(new_id()), stream, config_of(SLOW)
        )
        waiting = asyncio.create_task(operation.wait())
        await asyncio.to_thread(server.child_pid)
        waiting.cancel()
        with pytest.raises(asyncio.CancelledError):
            await waiting
        await client.delete_event_stream(stream)  # refused while a build reads it

    run(server.address, interrupt)


def test_a_server_that_is_not_there_is_named():
    with pytest.raises(UnavailableError, match=NOWHERE):
        run(NOWHERE, lambda client: client.capabilities())
