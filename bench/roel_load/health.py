"""How fast a health check is answered while builds run.

    python -m roel_load.health EVENTS --poses FILE --camera FILE [--builds 2] [--checks 1000]

The recording is uploaded once and built as often as said, at the same time. Checks follow each other
at fixed times, whether or not the one before was answered, first on the idle server, then while all
builds run.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
import tempfile
import time
from pathlib import Path

import grpc
import numpy as np
from grpc_health.v1 import health_pb2, health_pb2_grpc

from roel_client import Client
from roel_load.servers import served
from roel_service.config.presets import preset
from roel_service.io.camera import read_camera
from roel_service.io.events import open_events
from roel_service.io.poses import read_trajectory

INTERVAL_S = 0.02


async def check_latencies_ms(address: str, count: int) -> list[float]:
    """Milliseconds from when each check was due to its answer."""
    async with grpc.aio.insecure_channel(address) as channel:
        stub = health_pb2_grpc.HealthStub(channel)
        await stub.Check(health_pb2.HealthCheckRequest())
        start_s = time.perf_counter()

        async def check(index: int) -> float:
            due_s = start_s + index * INTERVAL_S
            await asyncio.sleep(due_s - time.perf_counter())
            await stub.Check(health_pb2.HealthCheckRequest())
            return 1000 * (time.perf_counter() - due_s)

        return await asyncio.gather(*(check(index) for index in range(count)))


def percentiles(latencies_ms: list[float]) -> dict[str, float]:
    """What is told of a run."""
    p50, p99 = np.percentile(latencies_ms, [50, 99])
    return {"p50_ms": round(p50, 2), "p99_ms": round(p99, 2), "max_ms": round(max(latencies_ms), 2)}


def measure(options: argparse.Namespace, data: Path) -> dict[str, object]:
    """Latencies on the idle server and while the builds run."""
    camera = read_camera(options.camera)
    events = open_events(options.events, camera.width, camera.height)
    with served(data) as address, Client(address) as client:
        stream = client.create_event_stream("load", camera)
        client.upload_poses(stream, read_trajectory(options.poses))
        client.upload_events(stream, events)
        client.finalize(stream)
        idle_ms = asyncio.run(check_latencies_ms(address, options.checks))
        begun = [
            client.build_map(client.create_map(f"load-{index}"), stream, preset("default"))
            for index in range(options.builds)
        ]
        time.sleep(options.settle)
        building_ms = asyncio.run(check_latencies_ms(address, options.checks))
        running_count = sum(not operation.is_done() for operation in begun)
        for operation in begun:
            operation.cancel()
    return {
        "idle": percentiles(idle_ms),
        "building": percentiles(building_ms),
        "builds_still_running": running_count,
    }


def main() -> None:
    """Measure, and print the figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("events", type=Path)
    parser.add_argument("--poses", type=Path, required=True)
    parser.add_argument("--camera", type=Path, required=True)
    parser.add_argument("--builds", type=int, default=2)
    parser.add_argument("--checks", type=int, default=1000)
    parser.add_argument("--settle", type=float, default=4.0, help="seconds before the checks")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        json.dump(measure(options, Path(folder)), sys.stdout, indent=1)
        sys.stdout.write("\n")


if __name__ == "__main__":
    main()
