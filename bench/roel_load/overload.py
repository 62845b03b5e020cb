"""What a server does with more calls than it can take: an open loop of lookups.

    python -m roel_load.overload [--seconds 5] [--factors 0.5 1 2 3]

First the capacity: as many calls as come back when a fixed number is always under way. Then calls at
multiples of it, each at its time whether or not earlier ones were answered. Goodput is what is
answered within the deadline, as a share of the capacity. Two kinds of lookups: one map, which costs
the server little more than any call does, and a page of a hundred. Somebody else asks for the
server's health all the while.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import grpc
import numpy as np
from google.rpc import status_pb2
from grpc_health.v1 import health_pb2, health_pb2_grpc

from roel_client import Client
from roel_load.servers import served
from roel_service.errors import RoelError
from roel_service.v1 import maps_pb2, maps_pb2_grpc
from roel_service.wire import names
from roel_service.wire.errors import error_from_status

UNDER_WAY_COUNT = 32
DEADLINE_S = 1.0
MAP_COUNT = 100
HEALTH_INTERVAL_S = 0.05


# What is to be called: a method and its request.
Lookup = tuple[Any, Any]


class Load:
    """Calls of one kind, and what became of them."""

    def __init__(self, lookup: Lookup) -> None:
        self._method, self._request = lookup
        self.endings: Counter[str] = Counter()
        self.latencies_ms: list[float] = []

    async def call(self) -> None:
        """One call."""
        start_s = time.perf_counter()
        try:
            await self._method(self._request, timeout=DEADLINE_S)
        except grpc.RpcError as error:
            self.endings[_reason(error)] += 1
        else:
            self.endings["OK"] += 1
            self.latencies_ms.append(1000 * (time.perf_counter() - start_s))


def _reason(error: Any) -> str:
    """The server's reason, or the code where the server did not answer in time."""
    details = dict(error.trailing_metadata() or ()).get("grpc-status-details-bin")
    if details is None:
        dropped = error.code() is grpc.StatusCode.CANCELLED
        return "DROPPED" if dropped else str(error.code().name)
    told = error_from_status(status_pb2.Status.FromString(details))
    return told.reason if isinstance(told, RoelError) else "CANCELLED"


async def closed_loop(lookup: Lookup, seconds: float) -> float:
    """Answers per second when a fixed number of calls is always under way."""
    load = Load(lookup)
    end_s = time.perf_counter() + seconds

    async def caller() -> None:
        while time.perf_counter() < end_s:
            await load.call()

    await asyncio.gather(*(caller() for _ in range(UNDER_WAY_COUNT)))
    return load.endings["OK"] / seconds


async def open_loop(lookup: Lookup, calls_per_s: float, seconds: float) -> dict[str, Any]:
    """What becomes of calls at a rate."""
    load = Load(lookup)
    start_s = time.perf_counter()
    calls = []
    for index in range(int(calls_per_s * seconds)):
        pause_s = start_s + index / calls_per_s - time.perf_counter()
        if pause_s > 0:
            await asyncio.sleep(pause_s)
        calls.append(asyncio.create_task(load.call()))
    await asyncio.gather(*calls)
    spent_s = time.perf_counter() - start_s
    p50, p99 = np.percentile(load.latencies_ms, [50, 99]) if load.latencies_ms else (0.0, 0.0)
    return {
        "offered_per_s": round(len(calls) / spent_s),
        "answered_per_s": round(load.endings["OK"] / spent_s),
        "endings": dict(load.endings),
        "p50_ms": round(float(p50), 1),
        "p99_ms": round(float(p99), 1),
    }


async def health(address: str, latencies_ms: list[float]) -> None:
    """Ask for it, for ever."""
    async with grpc.aio.insecure_channel(address) as channel:
        stub = health_pb2_grpc.HealthStub(channel)
        while True:
            start_s = time.perf_counter()
            await stub.Check(health_pb2.HealthCheckRequest(), timeout=60.0)
            latencies_ms.append(1000 * (time.perf_counter() - start_s))
            await asyncio.sleep(HEALTH_INTERVAL_S)


async def overloaded(
    address: str, lookup: Lookup, calls_per_s: float, seconds: float
) -> dict[str, Any]:
    """As `open_loop`, with the times of health checks."""
    latencies_ms: list[float] = []
    asking = asyncio.create_task(health(address, latencies_ms))
    row = await open_loop(lookup, calls_per_s, seconds)
    asking.cancel()
    return {**row, "health_p99_ms": round(float(np.percentile(latencies_ms, 99)), 1)}


async def measure(address: str, name: str, seconds: float, factors: list[float]) -> dict[str, Any]:
    """Of each kind of lookup the capacity, and a row for each factor."""
    figures: dict[str, Any] = {}
    async with grpc.aio.insecure_channel(address) as channel:
        stub = maps_pb2_grpc.MapServiceStub(channel)
        lookups: dict[str, Lookup] = {
            "one_map": (stub.GetMap, maps_pb2.GetMapRequest(name=name)),
            "page": (
                stub.ListMaps,
                maps_pb2.ListMapsRequest(parent=names.PROJECT, page_size=MAP_COUNT),
            ),
        }
        for kind, lookup in lookups.items():
            capacity = await closed_loop(lookup, seconds)
            rows = []
            for factor in factors:
                row = await overloaded(address, lookup, factor * capacity, seconds)
                goodput = row["answered_per_s"] / capacity
                rows.append({"factor": factor, "goodput": round(goodput, 2), **row})
            figures[kind] = {"capacity_per_s": round(capacity), "rows": rows}
    return figures


def main() -> None:
    """Measure, and print the figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--factors", type=float, nargs="+", default=[0.5, 1.0, 2.0, 3.0])
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, served(Path(folder)) as address:
        with Client(address) as client:
            for index in range(MAP_COUNT):
                name = client.create_map(f"load-{index:03}")
        figures = asyncio.run(measure(address, name, options.seconds, options.factors))
    json.dump(figures, sys.stdout, indent=1)
    sys.stdout.write("\n")


if __name__ == "__main__":
    main()
