"""How fast a recording becomes durable on a server of this machine.

    python -m roel_load.upload EVENTS --camera FILE [--events 100000000]

The recording is read into memory, repeated in time until it is long enough, and uploaded to a
server that is started for it. What is measured is encoding, sending, checking and making durable.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import resource
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from roel_client import Client
from roel_load.servers import served_by
from roel_service.io.camera import read_camera
from roel_service.io.events import open_events
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventStream


@dataclass(frozen=True, kw_only=True)
class UploadFigures:
    """What an upload took; processor time counts all threads."""

    event_count: int
    bytes_per_event: float
    seconds: float
    events_per_s: float
    client_cpu_ns_per_event: float
    server_cpu_ns_per_event: float


class RepeatedRecording:
    """A recording in memory, again and again, until it has a number of events.

    All of it is there before anything is measured: making events is not the upload's work.
    """

    def __init__(self, chunks: list[EventStream], event_count: int) -> None:
        self.width, self.height = chunks[0].width, chunks[0].height
        self.time_range_us = None
        self._chunks = list(_repeated(chunks, event_count))

    def chunks(self) -> Iterator[EventStream]:
        """Chunks in the order of time."""
        yield from self._chunks


def _repeated(chunks: list[EventStream], event_count: int) -> Iterator[EventStream]:
    """Each repetition after the one before."""
    left_count = event_count
    period_us = int(chunks[-1].t_us[-1] - chunks[0].t_us[0]) + 1
    for turn in itertools.count():
        for chunk in chunks:
            if left_count <= 0:
                return
            yield _shifted(chunk, turn * period_us, left_count)
            left_count -= len(chunk)


def _shifted(chunk: EventStream, offset_us: int, count: int) -> EventStream:
    """The first events of a chunk, later."""
    return EventStream(
        t_us=chunk.t_us[:count] + offset_us,
        x=chunk.x[:count],
        y=chunk.y[:count],
        polarity=chunk.polarity[:count],
        width=chunk.width,
        height=chunk.height,
    )


def measure_upload(source: RepeatedRecording, camera: Camera, folder: Path) -> UploadFigures:
    """Upload once to a fresh server."""
    with served_by(folder) as (address, process_id), Client(address) as client:
        stream = client.create_event_stream("recording", camera)
        server_before_s, client_before_s = _cpu_s(process_id), _own_cpu_s()
        start_s = time.perf_counter()
        record = client.upload_events(stream, source)
        seconds = time.perf_counter() - start_s
        server_s, client_s = _cpu_s(process_id), _own_cpu_s()
    count = record.event_count
    return UploadFigures(
        event_count=count,
        bytes_per_event=record.size_bytes / count,
        seconds=seconds,
        events_per_s=count / seconds,
        client_cpu_ns_per_event=(client_s - client_before_s) / count * 1e9,
        server_cpu_ns_per_event=(server_s - server_before_s) / count * 1e9,
    )


def _cpu_s(process_id: int) -> float:
    """Processor time of a process so far (Linux)."""
    fields = Path(f"/proc/{process_id}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _own_cpu_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def main() -> None:
    """Measure what the command line names; one JSON line for each run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path, help="HDF5, NPZ or text")
    parser.add_argument("--camera", type=Path, required=True, help="its calibration")
    parser.add_argument("--events", type=int, default=100_000_000, help="how many to upload")
    parser.add_argument("--runs", type=int, default=1)
    parser.add_argument("--data", type=Path, help="where the server keeps its data; default: /tmp")
    options = parser.parse_args()
    camera = read_camera(options.camera, None)
    chunks = list(open_events(options.recording, camera.width, camera.height).chunks())
    source = RepeatedRecording(chunks, options.events)
    for _ in range(options.runs):
        with tempfile.TemporaryDirectory(dir=options.data) as folder:
            print(json.dumps(vars(measure_upload(source, camera, Path(folder) / "data"))))


if __name__ == "__main__":
    main()
