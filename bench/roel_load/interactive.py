"""What the server adds to Register and Localize: the same questions in process and through it.

    python -m roel_load.interactive MAP.rlm --cloud FILE --panoramas FILE ... [--calls 10] [--callers 2]

In process everything is prepared once, then asked one question after the other. Through the server
the first call pays for the start of a child and for the preparation; then one caller asks, for the
times of a call, and at last several at once, for calls per second. Processor seconds are those of
this process, or of the server with its children, for each call.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from roel_client import Client
from roel_load.servers import served_by
from roel_service.config.stages import LocalizeConfig, RegisterConfig
from roel_service.io.clouds import read_cloud
from roel_service.io.images import decode_panorama
from roel_service.pano_loc.localize import localize_panorama
from roel_service.pano_loc.prepare import prepare_map
from roel_service.register.prepare import prepare_cloud
from roel_service.register.register import register_map
from roel_service.wire.rlm import decode_map

TIMEOUT_S = 300.0

# Asks the question of a number; the caller goes through the numbers.
Ask = Callable[[int], object]


def in_process(options: argparse.Namespace) -> dict[str, Ask]:
    """Everything prepared, in this process."""
    line_map = decode_map(options.map.read_bytes()).line_map
    cloud = prepare_cloud(read_cloud(options.cloud), RegisterConfig())
    prepared = [prepare_map(line_map, LocalizeConfig())]
    pictures = [path.read_bytes() for path in options.panoramas]

    def localize(number: int) -> object:
        grey = decode_panorama(pictures[number % len(pictures)])
        return localize_panorama(grey, prepared, LocalizeConfig())

    return {
        "register": lambda number: register_map(line_map, cloud, RegisterConfig()),
        "localize": localize,
    }


def through(client: Client, version: str, options: argparse.Namespace) -> dict[str, Ask]:
    """The same questions, to a server."""
    cloud = client.upload_blob(options.cloud)
    pictures = [path.read_bytes() for path in options.panoramas]
    return {
        "register": lambda number: client.register(version, cloud, timeout_s=TIMEOUT_S),
        "localize": lambda number: client.localize(
            [version], pictures[number % len(pictures)], timeout_s=TIMEOUT_S
        ),
    }


def one_by_one(ask: Ask, count: int, spent_s: Callable[[], float]) -> dict[str, float]:
    """Times of calls that follow one another."""
    ask(0)
    times_ms, before_s = [], spent_s()
    for number in range(count):
        start_s = time.perf_counter()
        ask(number)
        times_ms.append(1000 * (time.perf_counter() - start_s))
    p50, p99 = np.percentile(times_ms, [50, 99])
    return {
        "p50_ms": round(float(p50), 1),
        "p99_ms": round(float(p99), 1),
        "cpu_ms": round(1000 * (spent_s() - before_s) / count, 1),
    }


def calls_per_s(ask: Ask, count: int, caller_count: int) -> float:
    """Answers per second when several callers ask."""
    numbers = itertools.count()
    start_s = time.perf_counter()
    with ThreadPoolExecutor(caller_count) as callers:
        list(callers.map(lambda _: ask(next(numbers)), range(count)))
    return round(count / (time.perf_counter() - start_s), 2)


def tree_cpu_s(pid: int) -> float:
    """Processor seconds of a process and of those below it that live."""
    ticks = sum(_ticks(found) for found in [pid, *_descendants(pid)])
    return ticks / os.sysconf("SC_CLK_TCK")


def _descendants(pid: int) -> list[int]:
    threads = Path(f"/proc/{pid}/task")
    children = [
        int(child) for path in threads.glob("*/children") for child in path.read_text().split()
    ]
    return [found for child in children for found in (child, *_descendants(child))]


def _ticks(pid: int) -> int:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return int(fields[11]) + int(fields[12])


def measure(options: argparse.Namespace, data: Path) -> dict[str, Any]:
    """A row for each method and place."""
    rows: dict[str, Any] = {}
    for name, ask in in_process(options).items():
        rows[name] = {"in_process": one_by_one(ask, options.calls, time.process_time)}
    with (
        served_by(data) as (address, pid),
        Client(address) as client,
        client.hosted_map(options.map) as version,
    ):
        for name, ask in through(client, version, options).items():
            rows[name]["served"] = served_row(ask, pid, options)
    return rows


def served_row(ask: Ask, pid: int, options: argparse.Namespace) -> dict[str, float]:
    """What a method of the server takes."""
    start_s = time.perf_counter()
    ask(0)
    first_ms = 1000 * (time.perf_counter() - start_s)
    alone = one_by_one(ask, options.calls, lambda: tree_cpu_s(pid))
    # Every child has to meet the inputs once.
    calls_per_s(ask, 2 * options.callers, options.callers)
    together = calls_per_s(ask, options.calls, options.callers)
    return {
        "first_ms": round(first_ms),
        **alone,
        "calls_per_s": together,
        "callers": options.callers,
    }


def main() -> None:
    """Measure, and print the figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("map", type=Path)
    parser.add_argument("--cloud", type=Path, required=True)
    parser.add_argument("--panoramas", type=Path, nargs="+", required=True)
    parser.add_argument("--calls", type=int, default=10)
    parser.add_argument("--callers", type=int, default=2)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        json.dump(measure(options, Path(folder)), sys.stdout, indent=1)
        sys.stdout.write("\n")


if __name__ == "__main__":
    main()
