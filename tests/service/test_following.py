"""What a caller says while a child is at work."""

import asyncio

from roel_service.service.following import MAX_AHEAD_COUNT, ReadAhead
from roel_service.service.settings import Settings
from roel_service.v1 import events_pb2, localization_pb2


async def chunks(count, sent):
    for seq in range(count):
        sent.append(seq)
        chunk = events_pb2.EventChunk(seq=seq, data=b"")
        yield localization_pb2.TrackPosesRequest(chunk=chunk)


def test_what_has_come_meanwhile_is_handed_over_together():
    async def scenario():
        ahead = ReadAhead()
        await ahead.read(chunks(3, []), Settings())
        return [[saying.seq for saying in sayings] async for sayings in ahead.sayings()]

    assert asyncio.run(scenario()) == [[0, 1, 2]]


def test_it_is_read_so_far_ahead_and_no_further():
    async def scenario():
        ahead, sent, heard = ReadAhead(), [], []
        reading = asyncio.create_task(ahead.read(chunks(50, sent), Settings()))
        async for sayings in ahead.sayings():
            # What can be read is, before these are worked off.
            for _ in range(100):
                await asyncio.sleep(0)
            heard += [saying.seq for saying in sayings]
            # One more is in the hand that waits for room.
            assert len(sent) <= len(heard) + MAX_AHEAD_COUNT + 1
        await reading
        return heard

    assert asyncio.run(scenario()) == list(range(50))
