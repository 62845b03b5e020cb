"""Work for children; each function is an entry point."""

import os
import signal
import time
from pathlib import Path

from roel_service.errors import EventsError
from roel_service.progress import Progress
from roel_service.store.builds import BuiltVersion


def step(stage, done_count=0):
    return Progress(stage=stage, done_count=done_count, total_count=3, fraction=done_count / 3)


def double(parameters, progress):
    progress(step("first"))
    progress(step("second", 1))
    return 2 * parameters


def refuse(parameters, progress):
    raise EventsError(parameters, "events", "none", reason="NO_EVENTS")


def fail(parameters, progress):
    raise ZeroDivisionError("a bug")


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
    os.kill(os.getpid(), signal.SIGKILL)


def chatter(parameters, progress):
    """Far more progress than anybody wants to know."""
    for count in range(10_000):
        progress(step("first" if count < 5000 else "second", count))
    return "said"


def return_big(parameters, progress):
    return b"x" * parameters


def build_nothing(parameters, progress):
    return BuiltVersion(rlm_bytes=b"map", line_count=0, bounds_m=[0.0] * 6, report={})
