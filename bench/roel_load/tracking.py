"""How late are the poses of a camera that is followed through a server?

    python -m roel_load.tracking --walk WALK MAP.npz [--packet-ms 5 10 25]

A client sends packets of events at the pace at which they were made. Client, server and child share
the machine. Walks and maps are those of `python -m roel_bench.tracking`; each begins 20 cm and 10
degrees off.
"""

from __future__ import annotations

import argparse
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from roel_bench.tracking import Walk, farthest_guess, open_walk, pieces
from roel_client import Client
from roel_load.following import Live
from roel_load.servers import served
from roel_service.config.stages import TrackConfig
from roel_service.scene.events import concatenate
from roel_service.scene.results import PoseStatus, TrackedPose
from roel_service.tracking.tracker import FINDING_HALF_US
from roel_service.wire.provenance import Provenance
from roel_service.wire.rlm import encode_map

HEADER = """\
| walk | packet ms | ready s | poses, TRACKING, LOST | TRACKING ms | UNCERTAIN ms | LOST ms |
| --- | --- | --- | --- | --- | --- | --- |"""


def measure(client: Client, walk: Walk, map_version: str, packet_ms: int) -> str:
    """A row: time until events are waited for, and lateness of the poses."""
    first_us, last_us = (int(t_us) for t_us in walk.trajectory.t_us[[0, -1]])
    events = concatenate([part for part, _ in pieces(walk.events, first_us, last_us)])
    live = Live(events, speed=1.0, packet_us=1_000 * packet_ms)
    found = walk.trajectory.interpolate(np.array([first_us + FINDING_HALF_US]))[0]
    guess = farthest_guess(found, TrackConfig(), np.random.default_rng(0))
    told: list[tuple[float, TrackedPose]] = []
    called_s = time.monotonic()
    with client.tracking(map_version, walk.camera, guess) as tracking:
        ready_s = time.monotonic() - called_s

        def receive() -> None:
            while (pose := tracking.receive()) is not None:
                told.append((time.monotonic(), pose))

        receiving = threading.Thread(target=receive)
        receiving.start()
        for packet in live.chunks():
            tracking.send(packet)
        tracking.finish()
        receiving.join()
    begin_us = int(events.t_us[0])
    late_ms: dict[PoseStatus, list[float]] = {status: [] for status in PoseStatus}
    for told_s, pose in told:
        happened_s = live.began_s + 1e-6 * (pose.t_us - begin_us)
        late_ms[pose.status].append(1e3 * (told_s - happened_s))
    counts = [len(told), len(late_ms[PoseStatus.TRACKING]), len(late_ms[PoseStatus.LOST])]
    shown = (PoseStatus.TRACKING, PoseStatus.UNCERTAIN, PoseStatus.LOST)
    cells = [
        walk.name,
        f"{packet_ms}",
        f"{ready_s:.1f}",
        ", ".join(map(str, counts)),
        *(_spread(late_ms[status]) for status in shown),
    ]
    return f"| {' | '.join(cells)} |"


def _spread(late_ms: list[float]) -> str:
    """Median, 95 % and the largest."""
    if not late_ms:
        return ""
    return ", ".join(f"{value:.0f}" for value in np.quantile(late_ms, [0.5, 0.95, 1.0]))


def main() -> None:
    """Print a table: how long after the middle of its window each pose was there."""
    parser = argparse.ArgumentParser(prog="python -m roel_load.tracking")
    parser.add_argument("--walk", nargs=2, action="append", required=True, metavar=("DIR", "NPZ"))
    parser.add_argument("--packet-ms", type=int, nargs="+", default=[5, 10, 25])
    options = parser.parse_args()
    print(HEADER)
    with (
        tempfile.TemporaryDirectory() as folder,
        served(Path(folder, "data")) as address,
        Client(address, timeout_s=120.0) as client,
    ):
        for recording, exported in options.walk:
            walk = open_walk(Path(recording), Path(exported))
            path = Path(folder, "map.rlm")
            path.write_bytes(encode_map(walk.line_map, Provenance()))
            with client.hosted_map(path) as map_version:
                for packet_ms in options.packet_ms:
                    print(measure(client, walk, map_version, packet_ms), flush=True)


if __name__ == "__main__":
    main()
