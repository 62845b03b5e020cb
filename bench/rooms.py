"""Seconds and figures of a build on simulated rooms: `make bench`.

    python bench/rooms.py [--seeds 11 12 13] [--seconds 4] [--preset default paper]

The rooms are simulated first, which is not timed; numba's kernels are compiled by a first build of
which nothing is reported.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

from roel_client import local
from roel_service.config.presets import preset
from roel_service.progress import ignore

FIGURES = ("line_count", "accuracy_mm", "completion_mm", "iou_5", "iou_10", "iou_20")


def main() -> None:
    """Print one row a room and preset."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[101, 102, 103])
    parser.add_argument("--seconds", type=float, default=4.0)
    parser.add_argument("--preset", nargs="+", default=["default"])
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="roel-bench-") as folder:
        rooms = [simulated(Path(folder), seed, options.seconds) for seed in options.seeds]
        built(rooms[0], options.preset[0])
        for name in options.preset:
            for room in rooms:
                print_row(name, room.name, built(room, name))


def simulated(folder: Path, seed: int, seconds: float) -> Path:
    """A new room."""
    room = folder / f"room_{seed}"
    local.simulate(room, seed, ignore, seconds=seconds, panorama_count=0)
    return room


def built(room: Path, name: str) -> dict[str, Any]:
    """The report of a build, with the figures of its map against the truth."""
    files = [str(room / file) for file in ("events.h5", "poses.txt", "camera.json")]
    recording = local.open_recording(*files, sensor_size=None)
    result = local.build_map(recording, preset(name), ignore)
    (room / "map.rlm").write_bytes(result.rlm_bytes)
    truth = str(room / "gt.npz")
    return {**local.evaluate_map(str(room / "map.rlm"), truth, truth), **result.report}


def print_row(name: str, room: str, row: dict[str, Any]) -> None:
    """Figures, then seconds of each stage."""
    figures = "  ".join(f"{key} {row[key]:.4g}" for key in FIGURES)
    seconds = "  ".join(f"{stage} {value:.2f}" for stage, value in row["seconds"].items())
    print(f"{name} {room}: {figures}\n    {row['seconds_total']:.1f} s: {seconds}")


if __name__ == "__main__":
    main()
