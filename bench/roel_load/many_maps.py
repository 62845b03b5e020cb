"""A data folder with many maps: how soon its server is ready, and how fast it lists and looks up.

    python -m roel_load.many_maps [--maps 10000] [--calls 200]

The maps are written straight into the folder, each with its own file; then a server is started on it
and asked over gRPC, one call after the other.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
import random
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import Table, create_engine, insert

from roel_client import Client
from roel_client.connection import Connection, Endpoint
from roel_load.servers import served
from roel_service.scene.lines import LineMap
from roel_service.store.blobs import BlobStore
from roel_service.store.operations import queued_operation
from roel_service.store.records import (
    MapRecord,
    MapVersionRecord,
    OperationMethod,
    OperationRecord,
    OperationState,
    VersionState,
    now_us,
    row_from_record,
    stored,
)
from roel_service.store.retention import DAY_US, OPERATION_RETENTION_DAYS
from roel_service.store.schema import MAP, MAP_VERSION, OPERATION
from roel_service.store.store import Store
from roel_service.v1 import maps_pb2, maps_pb2_grpc
from roel_service.wire.provenance import Provenance
from roel_service.wire.rlm import encode_map

PARENT = "projects/default"
LINE_COUNT = 20


def fill(data: Path, map_count: int) -> None:
    """Write maps of one version each: rows in one transaction, files without waiting for the disk."""
    with Store(data):
        pass
    blobs = BlobStore(data / "blobs" / "sha256")
    rng = np.random.default_rng(0)
    rows: dict[Table, list[dict[str, Any]]] = {MAP: [], MAP_VERSION: [], OPERATION: []}
    for index in range(map_count):
        segments = rng.uniform(0, 8, (LINE_COUNT, 2, 3))
        rlm_bytes = encode_map(LineMap.from_segments(segments), Provenance())
        sha256 = hashlib.sha256(rlm_bytes).hexdigest()
        blobs.path(sha256).parent.mkdir(parents=True, exist_ok=True)
        blobs.path(sha256).write_bytes(rlm_bytes)
        operation = ended_operation(map_id(index))
        version = MapVersionRecord(
            map_id=map_id(index),
            version=1,
            state=VersionState.ACTIVE,
            event_stream_id="",
            operation_id=operation.id,
            sha256=sha256,
            size_bytes=len(rlm_bytes),
            line_count=LINE_COUNT,
            bounds_m=[0.0] * 6,
            report={},
            create_time_us=now_us(),
        )
        rows[MAP].append(map_row(index))
        rows[MAP_VERSION].append(row_from_record(version))
        rows[OPERATION].append(row_from_record(operation))
    engine = create_engine(f"sqlite:///{data / 'rows.sqlite'}")
    with engine.begin() as connection:
        for table, values in rows.items():
            connection.execute(insert(table), values)
    engine.dispose()


def map_row(index: int) -> dict[str, Any]:
    """A map whose newest version is the first."""
    record = MapRecord(
        id=map_id(index),
        uid=f"{index:032x}",
        version_count=1,
        display_name=f"Room {index}",
        labels={"site": f"{index % 100}"},
        aliases={},
        revision=1,
        create_time_us=now_us(),
        update_time_us=now_us(),
        delete_time_us=0,
        purge_time_us=0,
    )
    row = record._asdict()
    del row["aliases"]
    return stored(row)


def ended_operation(name: str) -> OperationRecord:
    """An import that succeeded just now."""
    operation = queued_operation(OperationMethod.IMPORT_MAP, map_id=name, version=1)
    expire_time_us = now_us() + OPERATION_RETENTION_DAYS * DAY_US
    return dataclasses.replace(
        operation,
        state=OperationState.SUCCEEDED,
        end_time_us=now_us(),
        expire_time_us=expire_time_us,
    )


def map_id(index: int) -> str:
    """Ids in the order of the numbers."""
    return f"map-{index:06}"


def ready_s_of(data: Path) -> float:
    """Seconds until a server on a folder answers."""
    start_s = time.perf_counter()
    with served(data):
        return time.perf_counter() - start_s


def milliseconds(call: Callable[[], Any], call_count: int) -> dict[str, float]:
    """What is told of a call that is made many times."""
    times_ms = []
    for _ in range(call_count):
        start_s = time.perf_counter()
        call()
        times_ms.append(1000 * (time.perf_counter() - start_s))
    p50, p99 = np.percentile(times_ms, [50, 99])
    return {"p50_ms": round(p50, 2), "p99_ms": round(p99, 2), "max_ms": round(max(times_ms), 2)}


def measure(options: argparse.Namespace, data: Path) -> dict[str, object]:
    """Seconds until the server is ready, and milliseconds of its calls."""
    fill(data, options.maps)
    empty_s = ready_s_of(data.with_name("empty"))
    choose = random.Random(0)
    start_s = time.perf_counter()
    with served(data) as address, Client(address) as client:
        ready_s = time.perf_counter() - start_s
        connection = Connection(Endpoint(address=address))
        maps = maps_pb2_grpc.MapServiceStub(connection.channel)

        def name() -> str:
            return f"{PARENT}/maps/{map_id(choose.randrange(options.maps))}"

        def page(size: int) -> Any:
            request = maps_pb2.ListMapsRequest(parent=PARENT, page_size=size)
            return connection.call(maps.ListMaps, request)

        figures = {
            # What a call costs that reads no row.
            "capabilities": milliseconds(client.capabilities, options.calls),
            "get": milliseconds(
                lambda: connection.call(maps.GetMap, maps_pb2.GetMapRequest(name=name())),
                options.calls,
            ),
            "get_version": milliseconds(
                lambda: client.map_version(f"{name()}/versions/latest"), options.calls
            ),
            "list_100": milliseconds(lambda: page(100), options.calls),
            "list_1000": milliseconds(lambda: page(1000), options.calls // 10),
        }
        connection.close()
    return {
        "maps": options.maps,
        "ready_s": round(ready_s, 2),
        "ready_s_without_maps": round(empty_s, 2),
        **figures,
    }


def main() -> None:
    """Measure, and print the figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--maps", type=int, default=10_000)
    parser.add_argument("--calls", type=int, default=200)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        json.dump(measure(options, Path(folder) / "data"), sys.stdout, indent=1)
        sys.stdout.write("\n")


if __name__ == "__main__":
    main()
