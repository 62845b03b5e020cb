"""Limits and drain, with calls that the test holds in its hands."""

import asyncio
from contextlib import asynccontextmanager

import grpc
import pytest

from roel_service.errors import DeadlineError, LimitError, UnavailableError
from roel_service.service.calls import Call
from roel_service.service.guards import CallLimits, Drain, FullMethods
from roel_service.service.settings import Settings

GET = "/roel_service.v1.MapService/GetMap"
LIST = "/roel_service.v1.MapService/ListMaps"
APPEND = "/roel_service.v1.EventStreamService/AppendEvents"
POSES = "/roel_service.v1.EventStreamService/AppendPoses"
WATCH = "/roel_service.v1.OperationService/WatchOperation"
REGISTER = "/roel_service.v1.RegistrationService/Register"
SETTINGS = Settings(
    calls_in_flight=1,
    calls_waiting=1,
    open_uploads=1,
    interactive_workers=1,
    interactive_queued=0,
)


class Work:
    """Calls at work behind a guard until they are told to end."""

    def __init__(self, guard):
        self.guard = guard
        self.begun = []
        self.end = asyncio.Event()

    def start(self, method, remaining_s=None):
        return asyncio.create_task(self._run(method, remaining_s))

    async def _run(self, method, remaining_s):
        end_s = remaining_s and asyncio.get_running_loop().time() + remaining_s
        async with self.guard(Call(method=method, end_s=end_s)):
            self.begun.append(method)
            await self.end.wait()


@asynccontextmanager
async def working(guard):
    work = Work(guard)
    yield work
    work.end.set()


async def settled():
    for _ in range(5):
        await asyncio.sleep(0)


def test_calls_beyond_the_limit_wait_and_then_are_refused():
    async def main():
        async with working(CallLimits(SETTINGS)) as work:
            first, second = work.start(GET), work.start(GET)
            await settled()
            assert work.begun == [GET]
            with pytest.raises(LimitError) as caught:
                await work.start(GET)
            assert caught.value.reason == "QUEUE_FULL"
            work.end.set()
            await asyncio.gather(first, second)
            assert work.begun == [GET, GET]

    asyncio.run(main())


def test_a_full_method_holds_up_no_other_and_no_watch():
    async def main():
        async with working(CallLimits(SETTINGS)) as work:
            tasks = [work.start(method) for method in (GET, GET, LIST, WATCH, WATCH, WATCH)]
            await settled()
            assert sorted(work.begun) == sorted([GET, LIST, WATCH, WATCH, WATCH])
            work.end.set()
            await asyncio.gather(*tasks)

    asyncio.run(main())


def test_all_uploads_share_one_limit():
    async def main():
        async with working(CallLimits(SETTINGS)) as work:
            uploads = [work.start(APPEND), work.start(POSES)]
            await settled()
            with pytest.raises(LimitError):
                await work.start(POSES)
            work.end.set()
            await asyncio.gather(*uploads)

    asyncio.run(main())


def test_questions_have_as_many_places_as_children():
    async def main():
        async with working(CallLimits(SETTINGS)) as work:
            question = work.start(REGISTER)
            await settled()
            with pytest.raises(LimitError):
                await work.start(REGISTER)
            work.end.set()
            await question

    asyncio.run(main())


def test_a_place_is_free_again_after_a_failure():
    async def main():
        limits = CallLimits(SETTINGS)
        for _ in range(5):
            with pytest.raises(KeyError):
                async with limits(Call(method=GET)):
                    raise KeyError

    asyncio.run(main())


def test_whoever_cannot_wait_long_enough_is_told_at_once():
    async def main():
        async with working(CallLimits(SETTINGS)) as work:
            slow = work.start(GET)
            await asyncio.sleep(0.05)
            work.end.set()
            await slow
            work.end.clear()
            first = work.start(GET)
            await settled()
            with pytest.raises(DeadlineError) as caught:
                await work.start(GET, remaining_s=0.001)
            assert caught.value.reason == "DEADLINE_TOO_SHORT"
            patient = work.start(GET, remaining_s=60)
            work.end.set()
            await asyncio.gather(first, patient)

    asyncio.run(main())


def test_a_drain_ends_uploads_and_refuses_calls():
    async def main():
        drain = Drain()
        async with working(drain) as work:
            upload = work.start(APPEND)
            await settled()
            drain.begin()
            for ended in (upload, work.start(GET), work.start(APPEND)):
                with pytest.raises(UnavailableError) as caught:
                    await ended
                assert caught.value.reason == "DRAINING"

    asyncio.run(main())


def test_a_drain_lets_others_end_and_then_ends_them():
    async def main():
        drain = Drain()
        async with working(drain) as work:
            watch, download = work.start(WATCH), work.start(GET)
            await settled()
            drain.begin()
            late = work.start(WATCH)
            await settled()
            assert work.begun == [WATCH, GET, WATCH]
            await drain.finish(grace_s=0.0)
            for ended in (watch, download, late):
                with pytest.raises(UnavailableError):
                    await ended

    asyncio.run(main())


def test_a_cancelled_call_stays_cancelled():
    async def main():
        async with working(Drain()) as work:
            task = work.start(WATCH)
            await settled()
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task

    asyncio.run(main())


def test_a_full_method_is_refused_before_the_guards_with_one_status():
    async def main():
        limits, noted = CallLimits(SETTINGS), []
        gate = FullMethods(limits, lambda *told: noted.append(told))
        async with working(limits) as work:
            assert gate(GET) is None
            tasks = [work.start(method) for method in (GET, GET, WATCH, WATCH)]
            await settled()
            status = gate(GET)
            assert status.code is grpc.StatusCode.RESOURCE_EXHAUSTED
            assert gate(GET) is status
            assert gate(LIST) is None
            assert gate(WATCH) is None
            work.end.set()
            await asyncio.gather(*tasks)
        assert gate(GET) is None
        assert noted == [(GET, "RESOURCE_EXHAUSTED")] * 2

    asyncio.run(main())
