"""How long after the last event is there a map? A build that follows the upload against one after it.

    python -m roel_load.following --recording $ROEL_DATA/rooms/room_12

The recording is uploaded at the speed at which it was made, or at a share of it on a busy machine.
"""

from __future__ import annotations

import argparse
import itertools
import json
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from roel_client import Client
from roel_client.client import Operation
from roel_load.servers import served
from roel_service.config.presets import preset
from roel_service.io.camera import read_camera
from roel_service.io.events import open_events
from roel_service.io.poses import read_trajectory
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventSource, EventStream
from roel_service.scene.trajectory import Trajectory
from roel_service.v1 import maps_pb2

# Events leave the sensor's driver in packets of about this length.
PACKET_US = 20_000
POLL_S = 0.05


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording:
    """What is uploaded."""

    events: EventSource
    trajectory: Trajectory
    camera: Camera


class Live:
    """Events at the speed at which they were made, or at a share of it.

    Attributes:
        began_s: when the first event happened, by `time.monotonic`; known once it has.
    """

    def __init__(self, source: EventSource, speed: float, packet_us: int = PACKET_US) -> None:
        self._speed = speed
        self._packets = list(_packets(source, packet_us))
        self.began_s = 0.0
        self.width, self.height = source.width, source.height
        self.time_range_us = source.time_range_us

    def chunks(self) -> Iterator[EventStream]:
        """Packets, each when its last event has happened."""
        self.began_s = time.monotonic()
        first_us = int(self._packets[0].t_us[0])
        for packet in self._packets:
            due_s = self.began_s + 1e-6 * (int(packet.t_us[-1]) - first_us) / self._speed
            time.sleep(max(0.0, due_s - time.monotonic()))
            yield packet


def _packets(source: EventSource, packet_us: int) -> Iterator[EventStream]:
    for chunk in source.chunks():
        edges_us = np.arange(chunk.t_us[0], chunk.t_us[-1] + packet_us, packet_us)
        rows = np.unique([*np.searchsorted(chunk.t_us, edges_us), len(chunk)])
        for start, stop in itertools.pairwise(rows):
            yield chunk.part(int(start), int(stop))


def measure(client: Client, recording: Recording, speed: float, *, follow: bool) -> dict[str, Any]:
    """Seconds from Finalize to the preview and to the refined map, and the map's digest."""
    config = preset("default")
    stream = client.create_event_stream("walk", recording.camera)
    map_name = client.create_map("house")
    client.upload_poses(stream, recording.trajectory)
    build: list[Operation] = []
    if follow:
        build.append(client.build_map(map_name, stream, config, follow=True))
    began_s = time.monotonic()
    client.upload_events(stream, Live(recording.events, speed))
    uploaded_s = time.monotonic()
    client.finalize(stream)
    finalized_s = time.monotonic()
    if not follow:
        build.append(client.build_map(map_name, stream, config))
    previews: list[float] = []
    ended = threading.Event()
    watching = threading.Thread(
        target=_watch, args=(client, f"{map_name}/versions/v1", previews, ended)
    )
    watching.start()
    version = build[0].wait()
    active_s = time.monotonic()
    ended.set()
    watching.join()
    return {
        "follow": follow,
        "upload_s": uploaded_s - began_s,
        "preview_s": previews[0] - finalized_s if previews else None,
        "active_s": active_s - finalized_s,
        "line_count": version.line_count,
        "map_sha256": version.map.sha256,
    }


def _watch(client: Client, name: str, previews: list[float], ended: threading.Event) -> None:
    """Note when a version can be used for the first time."""
    usable = (maps_pb2.MapVersion.STATE_PREVIEW, maps_pb2.MapVersion.STATE_ACTIVE)
    while not ended.is_set():
        if client.map_version(name).state in usable:
            previews.append(time.monotonic())
            return
        time.sleep(POLL_S)


def main() -> None:
    """Measure both ways, in turn, and print what came of it."""
    parser = argparse.ArgumentParser(prog="python -m roel_load.following")
    parser.add_argument("--recording", type=Path, required=True, help="folder as of roel simulate")
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--speed", type=float, default=1.0, help="of the upload; 1 is real time")
    options = parser.parse_args()
    camera = read_camera(options.recording / "camera.json")
    recording = Recording(
        events=open_events(options.recording / "events.h5", camera.width, camera.height),
        trajectory=read_trajectory(options.recording / "poses.txt"),
        camera=camera,
    )
    for follow in [False, True] * options.repeats:
        # A folder each: otherwise the second build takes the stages of the first one.
        with (
            tempfile.TemporaryDirectory() as folder,
            served(Path(folder, "data")) as address,
            Client(address, timeout_s=120.0) as client,
        ):
            print(json.dumps(measure(client, recording, options.speed, follow=follow)), flush=True)


if __name__ == "__main__":
    main()
