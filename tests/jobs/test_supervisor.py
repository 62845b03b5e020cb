import asyncio
import os
import subprocess
import sys
import time

import pytest

from roel_service.jobs.executors import ProcessExecutor
from roel_service.jobs.task import TaskSpec
from roel_service.progress import Progress


def spec(name, parameters=None):
    return TaskSpec(entrypoint=f"sample_tasks:{name}", parameters=parameters)


async def run(name, parameters=None):
    """Result and stages of one task."""
    stages = []

    async def note(news):
        if isinstance(news, Progress):
            stages.append(news.stage)

    return await ProcessExecutor(1).run(spec(name, parameters), note), stages


def is_alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_result_larger_than_any_pipe_buffer_arrives():
    result, _ = asyncio.run(run("return_big", 10_000_000))
    assert len(result) == 10_000_000


def test_progress_is_thinned_but_every_stage_is_told():
    result, stages = asyncio.run(run("chatter"))
    assert result == "said"
    assert sorted(set(stages)) == ["first", "second"]
    assert len(stages) < 100


@pytest.mark.parametrize("name", ["sleep", "hold_on"])
def test_cancelling_ends_the_child(name):
    async def cancel_when_it_sleeps():
        started = asyncio.Event()

        async def note(news):
            if isinstance(news, Progress):
                started.set()

        task = asyncio.create_task(ProcessExecutor(1).run(spec(name), note))
        await started.wait()
        task.cancel()
        await task

    with pytest.raises(asyncio.CancelledError):
        asyncio.run(asyncio.wait_for(cancel_when_it_sleeps(), 30))


FRONT = """
import asyncio, sys
from roel_service.jobs.executors import ProcessExecutor
from roel_service.jobs.task import TaskSpec
from roel_service.progress import Progress

async def note(news):
    if isinstance(news, Progress):
        print("started", flush=True)

if __name__ == "__main__":
    spec = TaskSpec(entrypoint="sample_tasks:tell_pid", parameters=sys.argv[1])
    asyncio.run(ProcessExecutor(1).run(spec, note))
"""


def test_a_child_does_not_outlive_a_killed_front(tmp_path):
    script, pid_file = tmp_path / "front.py", tmp_path / "pid"
    script.write_text(FRONT)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, script, pid_file]
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment) as front:
        assert front.stdout.readline() == b"started\n"
        front.kill()
    child = int(pid_file.read_text())
    deadline = time.monotonic() + 30
    while is_alive(child) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not is_alive(child)
