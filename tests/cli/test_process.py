from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable

import pytest

from roel_client.cli.process import Interrupted, interruptible, run_in_child


def test_exit_code_of_the_work_is_returned() -> None:
    assert run_in_child(lambda: 3) == 3


def test_work_happens_in_another_process(tmp_path: object) -> None:
    read_end, write_end = os.pipe()

    def work() -> int:
        os.write(write_end, str(os.getpid()).encode())
        return 0

    run_in_child(work)
    assert int(os.read(read_end, 20)) != os.getpid()
    os.close(read_end)
    os.close(write_end)


def test_child_ended_by_a_signal_is_told_apart() -> None:
    def die() -> int:
        os.kill(os.getpid(), signal.SIGKILL)
        return 0

    assert run_in_child(die) == -signal.SIGKILL


def interrupting_parent(number: int, then: Callable[[], None]) -> Callable[[], int]:
    def work() -> int:
        then()
        os.kill(os.getppid(), number)
        time.sleep(60)
        return 0

    return work


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_ends_the_child_and_is_told_by_exit_code(number: int) -> None:
    with pytest.raises(Interrupted) as caught, interruptible():
        run_in_child(interrupting_parent(number, lambda: None))
    assert caught.value.exit_code == 128 + number


def test_child_that_ignores_the_signal_is_killed() -> None:
    def ignore() -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)

    with pytest.raises(Interrupted), interruptible():
        run_in_child(interrupting_parent(signal.SIGTERM, ignore))


def test_handlers_are_restored() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with interruptible():
        assert signal.getsignal(signal.SIGTERM) is not before
    assert signal.getsignal(signal.SIGTERM) is before
