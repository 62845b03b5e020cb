import asyncio
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from roel_service.errors import EventsError, RoelError, UnavailableError
from roel_service.jobs.supervisor import run_in_child
from roel_service.jobs.task import TaskSpec


def spec(name, parameters=None):
    return TaskSpec(entrypoint=f"sample_tasks:{name}", parameters=parameters)


async def run(name, parameters=None):
    """Result and stages of one task."""
    stages = []

    async def note(progress):
        stages.append(progress.stage)

    return await run_in_child(spec(name, parameters), note), stages


def is_alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_child_returns_its_result_after_its_progress():
    assert asyncio.run(run("double", 21)) == (42, ["first", "second"])


def test_a_result_larger_than_any_pipe_buffer_arrives():
    result, _ = asyncio.run(run("return_big", 10_000_000))
    assert len(result) == 10_000_000


def test_progress_is_thinned_but_every_stage_is_told():
    result, stages = asyncio.run(run("chatter"))
    assert result == "said"
    assert sorted(set(stages)) == ["first", "second"]
    assert len(stages) < 100


def test_an_error_of_the_work_arrives_as_it_was_raised():
    with pytest.raises(EventsError, match="walk: expected events, found none") as caught:
        asyncio.run(run("refuse", "walk"))
    assert caught.value.reason == "NO_EVENTS"


def test_a_bug_is_internal_and_its_traceback_stays_in_the_log(capfd):
    with pytest.raises(RoelError) as caught:
        asyncio.run(run("fail"))
    assert type(caught.value) is RoelError
    assert caught.value.reason == "INTERNAL"
    assert "ZeroDivisionError" not in str(caught.value)
    assert "ZeroDivisionError: a bug" in capfd.readouterr().err


def test_an_unknown_entry_point_is_internal(capfd):
    with pytest.raises(RoelError, match="code 1"):
        asyncio.run(run("no_such_function"))
    assert "no_such_function" in capfd.readouterr().err


def test_a_killed_child_is_a_lost_worker():
    with pytest.raises(UnavailableError, match="SIGKILL") as caught:
        asyncio.run(run("die"))
    assert caught.value.reason == "WORKER_LOST"


@pytest.mark.parametrize("name", ["sleep", "hold_on"])
def test_cancelling_ends_the_child(name):
    async def cancel_when_it_sleeps():
        started = asyncio.Event()

        async def note(progress):
            started.set()

        task = asyncio.create_task(run_in_child(spec(name), note))
        await started.wait()
        task.cancel()
        await task

    with pytest.raises(asyncio.CancelledError):
        asyncio.run(asyncio.wait_for(cancel_when_it_sleeps(), 30))


FRONT = """
import asyncio, sys
from roel_service.jobs.supervisor import run_in_child
from roel_service.jobs.task import TaskSpec

async def note(progress):
    print("started", flush=True)

if __name__ == "__main__":
    spec = TaskSpec(entrypoint="sample_tasks:tell_pid", parameters=sys.argv[1])
    asyncio.run(run_in_child(spec, note))
"""


def test_a_child_does_not_outlive_a_killed_front(tmp_path):
    script, pid_file = tmp_path / "front.py", tmp_path / "pid"
    script.write_text(FRONT)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    command = [sys.executable, script, pid_file]
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment) as front:
        assert front.stdout.readline() == b"started\n"
        front.kill()
    child = int(pid_file.read_text())
    deadline = time.monotonic() + 30
    while is_alive(child) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not is_alive(child)
