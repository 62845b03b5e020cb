"""Work for children; each function is an entry point."""

import os
import signal
import threading
import time
from pathlib import Path

from roel_service.errors import EventsError, LimitError, UnavailableError
from roel_service.jobs.task import Partial
from roel_service.progress import Progress


def step(stage, done_count=0):
    return Progress(stage=stage, done_count=done_count, total_count=3, fraction=done_count / 3)


def double(parameters, progress):
    progress(step("first"))
    progress(step("second", 1))
    return 2 * parameters


def refuse(parameters, progress):
    raise EventsError(parameters, "events", "none", reason="NO_EVENTS")


def fail(parameters, progress):
    raise ZeroDivisionError("a bug", parameters)


def fail_elsewhere(parameters, progress):
    raise ZeroDivisionError("a bug", parameters)


def tell_half(parameters, tell):
    tell(Partial(result=parameters // 2))
    return parameters


def tell_environment(parameters, tell):
    return os.getpid(), os.environ.get(parameters)


def tell_thread(parameters, tell):
    return threading.get_ident()


def tick(parameters, tell):
    """Adds to a file and tells so, for a minute."""
    with Path(parameters).open("ab", buffering=0) as file:
        for count in range(6000):
            tell(step("tick", count))
            file.write(b".")
            time.sleep(0.01)


def fill_memory(parameters, tell):
    """Touches some MiB, a little at a time."""
    held = []
    for _ in range(parameters):
        held.append(bytearray(2**20))
        time.sleep(0.001)


def allocate_at_once(parameters, tell):
    return len(bytearray(parameters * 2**20))


def sleep(parameters, progress):
    progress(step("sleep"))
    time.sleep(60)


def hold_on(parameters, progress):
    """Does not end at SIGTERM."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    sleep(parameters, progress)


def tell_pid(parameters, progress):
    Path(parameters).write_text(str(os.getpid()))
    sleep(parameters, progress)


def die(parameters, progress):
    progress(step("die"))
    os.kill(os.getpid(), signal.Signals[parameters or "SIGKILL"])


def chatter(parameters, progress):
    """Far more progress than anybody wants to know."""
    for count in range(10_000):
        progress(step("first" if count < 5000 else "second", count))
    return "said"


def return_big(parameters, progress):
    return b"x" * parameters


def build_nothing(parameters, progress):
    from roel_service.store.builds import BuiltVersion

    return BuiltVersion(rlm_bytes=b"map", line_count=0, bounds_m=[0.0] * 6, report={})


def lose_worker(parameters, tell):
    raise UnavailableError("task", "a worker", "none", reason="WORKER_LOST")


def lose_worker_once(parameters, tell):
    if Path(parameters).exists():
        return build_nothing(None, tell)
    Path(parameters).touch()
    return lose_worker(None, tell)


def fail_differently(parameters, tell):
    """Each time with another class."""
    counter = Path(parameters)
    count = len(counter.read_bytes()) if counter.exists() else 0
    counter.write_bytes(b"." * (count + 1))
    raise (KeyError, IndexError, ValueError)[count]("a bug")


def run_out_of_memory(parameters, tell):
    raise LimitError("task", "less", "more", reason="TASK_OUT_OF_MEMORY")


def advance_slowly(parameters, tell):
    tell(step("first", 0))
    time.sleep(0.01)
    tell(step("first", 1))
    tell(step("second", 2))
    return build_nothing(None, tell)


def wait(parameters, tell):
    """Works until it is cancelled."""
    while True:
        tell(step("wait"))
        time.sleep(0.005)


def wait_for(parameters, tell):
    while not Path(parameters).exists():
        tell(step("wait"))
        time.sleep(0.005)
    return build_nothing(None, tell)


def preview_then_wait(parameters, tell):
    tell(Partial(result=build_nothing(None, tell)))
    wait(None, tell)


class Tally:
    """Keeps what it was told."""

    def __init__(self):
        self.told = []

    def __call__(self, parameters, tell):
        self.told.append(parameters)
        return list(self.told)


class Prepared:
    """Leaves a sign in its process once it is made."""

    def __init__(self):
        os.environ["PREPARED"] = "yes"

    def __call__(self, parameters, tell):
        return None


class SlowToMake:
    """Takes a while before its first task."""

    def __init__(self):
        time.sleep(0.6)

    def __call__(self, parameters, tell):
        return os.getpid()
