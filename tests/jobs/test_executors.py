import asyncio
import os
import threading

import pytest

from roel_service.errors import EventsError, LimitError, UnavailableError
from roel_service.jobs import warm as warming
from roel_service.jobs.executors import InlineExecutor, ProcessExecutor
from roel_service.jobs.faults import FaultError
from roel_service.jobs.task import Limits, Partial, TaskSpec, Usage
from roel_service.jobs.warm import WarmExecutor
from roel_service.progress import Progress

MIB = 2**20


def warm(capacity, preload="sample_tasks"):
    executor = WarmExecutor(capacity, queued_count=8, preload=preload)
    executor.start()
    return executor


def spec(name, parameters=None, **limits):
    return TaskSpec(
        entrypoint=f"sample_tasks:{name}", parameters=parameters, limits=Limits(**limits)
    )


async def ignore(news):
    pass


def using(make, scenario):
    """Result of a scenario with a new executor, which is closed afterwards."""

    async def closing():
        executor = make(1)
        try:
            return await asyncio.wait_for(scenario(executor), 60)
        finally:
            await executor.close()

    return asyncio.run(closing())


def heard(make, name, parameters=None):
    """Result of one task, and what it said before."""
    news = []

    async def note(told):
        if not isinstance(told, Usage):
            news.append(told)

    return using(make, lambda executor: executor.run(spec(name, parameters), note)), news


@pytest.mark.parametrize("make", [InlineExecutor, ProcessExecutor, warm])
class TestContract:
    def test_a_result_follows_the_progress(self, make):
        result, news = heard(make, "double", 21)
        assert result == 42
        assert [progress.stage for progress in news] == ["first", "second"]

    def test_a_partial_result_comes_before_the_last_one(self, make):
        result, news = heard(make, "tell_half", 8)
        assert (news, result) == ([Partial(result=4)], 8)

    def test_an_error_of_the_work_arrives_as_it_was_raised(self, make):
        with pytest.raises(EventsError, match="walk: expected events, found none") as caught:
            heard(make, "refuse", "walk")
        assert caught.value.reason == "NO_EVENTS"

    def test_a_bug_is_logged_with_an_id_and_told_without_details(self, make, caplog):
        with pytest.raises(FaultError) as caught:
            heard(make, "fail")
        assert caught.value.found.split()[-1] in caplog.text
        assert "ZeroDivisionError" in caplog.text
        assert "ZeroDivisionError" not in str(caught.value)

    def test_the_same_bug_has_the_same_fingerprint_and_another_one_has_not(self, make):
        async def scenario(executor):
            found = []
            for name, parameters in (("fail", 1), ("fail", 2), ("fail_elsewhere", 1)):
                with pytest.raises(FaultError) as caught:
                    await executor.run(spec(name, parameters), ignore)
                found.append(caught.value.fingerprint)
            return found

        first, again, elsewhere = using(make, scenario)
        assert first == again != elsewhere

    def test_an_unknown_entry_point_is_a_fault(self, make):
        with pytest.raises(FaultError):
            heard(make, "no_such_function")

    def test_a_cancelled_task_has_ended_when_cancelling_returns(self, make, tmp_path):
        ticks = tmp_path / "ticks"

        async def scenario(executor):
            started = asyncio.Event()

            async def note(news):
                if isinstance(news, Progress):
                    started.set()

            task = asyncio.create_task(executor.run(spec("tick", ticks), note))
            await started.wait()
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
            size = ticks.stat().st_size
            await asyncio.sleep(0.1)
            return ticks.stat().st_size - size

        assert using(make, scenario) == 0

    def test_it_takes_the_next_task_after_a_failed_and_a_cancelled_one(self, make):
        async def scenario(executor):
            with pytest.raises(FaultError):
                await executor.run(spec("fail"), ignore)
            with pytest.raises(TimeoutError):
                await asyncio.wait_for(executor.run(spec("tick", os.devnull), ignore), 0.05)
            return await executor.run(spec("double", 2), ignore)

        assert using(make, scenario) == 4


def test_a_warm_child_makes_its_object_before_the_first_task():
    def prepared(capacity):
        return warm(capacity, preload="sample_tasks:Prepared")

    (_, sign), _ = heard(prepared, "tell_environment", "PREPARED")
    assert sign == "yes"
    (_, sign), _ = heard(warm, "tell_environment", "PREPARED")
    assert sign is None


def slow_to_make(capacity):
    return warm(capacity, preload="sample_tasks:SlowToMake")


def test_what_a_child_loads_is_in_no_callers_time():
    async def scenario(executor):
        return await executor.run(spec("SlowToMake", time_s=0.3), ignore)

    assert using(slow_to_make, scenario) > 0


def test_a_caller_who_leaves_a_child_that_still_loads_leaves_it_to_the_next():
    async def scenario(executor):
        async with executor.held(2**40) as loading:
            with pytest.raises(TimeoutError):
                await asyncio.wait_for(loading.run(spec("SlowToMake"), ignore), 0.1)
        async with executor.held(2**40) as next_one:
            return loading is next_one, await next_one.run(spec("SlowToMake"), ignore)

    is_same, pid = using(slow_to_make, scenario)
    assert is_same
    assert pid != os.getpid()


@pytest.mark.parametrize("make", [ProcessExecutor, warm])
class TestChildren:
    def test_work_runs_in_another_process_with_one_thread_for_each_library(self, make):
        (pid, threads), _ = heard(make, "tell_environment", "OMP_NUM_THREADS")
        assert pid != os.getpid()
        assert threads == "1"

    def test_a_killed_child_is_a_lost_worker(self, make):
        with pytest.raises(UnavailableError, match="SIGKILL") as caught:
            heard(make, "die", "SIGKILL")
        assert caught.value.reason == "WORKER_LOST"

    def test_a_crash_is_a_fault(self, make):
        with pytest.raises(FaultError) as caught:
            heard(make, "die", "SIGSEGV")
        assert caught.value.fingerprint == "SIGSEGV"

    def test_a_child_that_takes_too_long_ends(self, make):
        async def scenario(executor):
            with pytest.raises(LimitError, match="within 0 s") as caught:
                await executor.run(spec("tick", os.devnull, time_s=0.1), ignore)
            return caught.value.reason

        assert using(make, scenario) == "TASK_TIME_LIMIT"

    def test_it_tells_what_it_uses(self, make):
        async def scenario(executor):
            used = asyncio.Queue()

            async def note(news):
                if isinstance(news, Usage):
                    used.put_nowait(news)

            task = asyncio.create_task(executor.run(spec("tick", os.devnull), note))
            usage = await used.get()
            task.cancel()
            await asyncio.wait({task})
            return usage

        usage = using(make, scenario)
        assert usage.peak_rss_mib > 5
        assert usage.cpu_s > 0


@pytest.mark.parametrize(
    ("make", "name"), [(ProcessExecutor, "allocate_at_once"), (warm, "fill_memory")]
)
def test_a_child_that_takes_too_much_memory_ends_and_the_next_one_works(make, name):
    async def scenario(executor):
        with pytest.raises(LimitError, match="at most 300 MiB") as caught:
            await executor.run(spec(name, 2000, memory_bytes=300 * MIB), ignore)
        assert caught.value.reason == "TASK_OUT_OF_MEMORY"
        return await executor.run(spec("double", 2), ignore)

    assert using(make, scenario) == 4


def test_a_warm_child_keeps_its_process_between_calls():
    async def scenario(executor):
        calls = [executor.run(spec("tell_environment", "HOME"), ignore) for _ in range(3)]
        return {(await call)[0] for call in calls}

    assert len(using(warm, scenario)) == 1


def test_a_warm_child_makes_one_object_of_a_class_and_a_new_child_another():
    async def scenario(executor):
        told = [await executor.run(spec("Tally", number), ignore) for number in (1, 2)]
        with pytest.raises(FaultError):
            await executor.run(spec("fail"), ignore)
        return [*told, await executor.run(spec("Tally", 3), ignore)]

    assert using(warm, scenario) == [[1], [1, 2], [3]]


def test_a_warm_child_is_replaced_before_it_grows_old(monkeypatch):
    monkeypatch.setattr(warming, "MAX_CALL_COUNT", 1)

    async def scenario(executor):
        calls = [executor.run(spec("tell_environment", "HOME"), ignore) for _ in range(2)]
        return {(await call)[0] for call in calls}

    assert len(using(warm, scenario)) == 2


def test_a_conversation_is_one_call_however_long(monkeypatch):
    monkeypatch.setattr(warming, "MAX_CALL_COUNT", 2)

    async def scenario(executor):
        pids = set()
        async with executor.held(2**40) as child:
            for _ in range(5):
                pids.add((await child.run(spec("tell_environment", "HOME"), ignore))[0])
        pids.add((await executor.run(spec("tell_environment", "HOME"), ignore))[0])
        return pids

    assert len(using(warm, scenario)) == 1


def test_the_first_call_starts_a_child_that_nobody_started_before():
    async def scenario(executor):
        calls = [executor.run(spec("tell_environment", "HOME"), ignore) for _ in range(2)]
        return {(await call)[0] for call in calls}

    assert len(using(lambda capacity: WarmExecutor(capacity, queued_count=8), scenario)) == 1


def test_calls_beyond_children_and_queue_are_refused():
    async def scenario(executor):
        executor = WarmExecutor(1, queued_count=0)
        executor.start()
        running = asyncio.create_task(executor.run(spec("tick", os.devnull), ignore))
        await asyncio.sleep(0)
        with pytest.raises(LimitError) as caught:
            await executor.run(spec("double", 1), ignore)
        running.cancel()
        await asyncio.wait({running})
        await executor.close()
        return caught.value.reason

    assert using(InlineExecutor, scenario) == "QUEUE_FULL"


def test_inline_work_runs_in_a_thread_so_that_the_loop_goes_on():
    result, _ = heard(InlineExecutor, "tell_thread")
    assert result != threading.get_ident()
