"""Builds that need no algorithm; the seed of the configuration picks one."""

import os
import signal
import time
from pathlib import Path

import numpy as np

from roel_service.config.load import to_tables
from roel_service.errors import NoAnswerError
from roel_service.progress import Progress
from roel_service.scene.lines import LineMap
from roel_service.scene.results import MAPPING_STAGES
from roel_service.store.builds import BuiltVersion
from roel_service.wire.provenance import Provenance
from roel_service.wire.rlm import encode_map

QUICK, SLOW, NO_ANSWER, BUG, SLOW_ONCE, DIE = range(6)

SEGMENTS = np.arange(18.0).reshape(3, 2, 3)


def build(parameters, progress):
    return BEHAVIOURS[parameters.config.runtime.seed](parameters, progress)


def quick(parameters, progress):
    """Reads all inputs, answers with a map of three lines."""
    if hasattr(parameters, "stream_id"):
        from roel_service.jobs.following import follow

        _, parameters = follow(parameters, progress)
    events, trajectory, _ = parameters.open()
    for index, stage in enumerate(MAPPING_STAGES):
        progress(Progress(stage=stage, done_count=1, total_count=1, fraction=index / 7))
    report = {
        "frame_count": len(trajectory),
        "event_count": sum(len(chunk) for chunk in events.chunks()),
        "line_count": len(SEGMENTS),
        "seconds": dict.fromkeys(MAPPING_STAGES, 0.25),
        "seconds_total": 1.75,
        "peak_rss_mib": 100.0,
        "config": to_tables(parameters.config),
        "versions": {"python": "3"},
    }
    rlm_bytes = encode_map(LineMap.from_segments(SEGMENTS), Provenance())
    bounds_m = [0.0, 1, 2, 15, 16, 17]
    return BuiltVersion(rlm_bytes=rlm_bytes, line_count=3, bounds_m=bounds_m, report=report)


def slow(parameters, progress):
    """Tells its process id, then works for a long time."""
    pid_file = Path(os.environ["SAMPLE_BUILD_PID"])
    pid_file.with_suffix(".part").write_text(str(os.getpid()))
    pid_file.with_suffix(".part").rename(pid_file)
    progress(Progress(stage="detect", done_count=1, total_count=9, fraction=0.1))
    time.sleep(120)


def give_up(parameters, progress):
    raise NoAnswerError("map", "at least 3 lines", "2", reason="TOO_FEW_LINES")


def fail(parameters, progress):
    raise ZeroDivisionError("a bug")


def slow_once(parameters, progress):
    """Slow in the first attempt, quick in the next one."""
    if Path(os.environ["SAMPLE_BUILD_PID"]).exists():
        return quick(parameters, progress)
    return slow(parameters, progress)


def die(parameters, progress):
    os.kill(os.getpid(), signal.SIGKILL)


BEHAVIOURS = {
    QUICK: quick,
    SLOW: slow,
    NO_ANSWER: give_up,
    BUG: fail,
    SLOW_ONCE: slow_once,
    DIE: die,
}
