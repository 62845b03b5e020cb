"""`roel map build` on recordings that are not part of the repository; see ROEL_DATA."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROEL = Path(sys.executable).with_name("roel")
MAX_MEMORY_MIB = 2048

pytestmark = [pytest.mark.data, pytest.mark.slow]


def roel(*arguments: str | Path, cwd: Path) -> str:
    done = subprocess.run([ROEL, *arguments], cwd=cwd, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def inputs(folder: Path, events: str, poses: str, camera: str) -> list[str | Path]:
    named = ("--events", folder / events, "--poses", folder / poses, "--camera", folder / camera)
    return list(named)


def test_slider_recording_gives_lines_at_plausible_depth(data_folder: Path, tmp_path: Path) -> None:
    recording = inputs(
        data_folder / "real" / "davis_slider_depth",
        "events_chunk.txt",
        "groundtruth.txt",
        "calib.txt",
    )
    options = ("--sensor-size", "240x180", "--out", "desk.rlm", "--plot", "desk.png")
    roel("map", "build", *recording, *options, cwd=tmp_path)
    roel("map", "export", "desk.rlm", "--out", "desk.npz", cwd=tmp_path)
    with np.load(tmp_path / "desk.npz") as exported:
        # The slider's poses have no rotation: z of the world is depth.
        middle_depth_m = exported["segments"][..., 2].mean(axis=1)
    assert len(middle_depth_m) >= 10
    assert ((middle_depth_m > 0.3) & (middle_depth_m < 2.0)).all()
    assert (tmp_path / "desk.png").read_bytes().startswith(b"\x89PNG")


def test_room_gives_the_same_map_here_and_on_a_server(
    data_folder: Path, tmp_path: Path, server: str
) -> None:
    recording = inputs(data_folder / "rooms" / "room_12", "events.h5", "poses.txt", "camera.json")
    here = roel("map", "build", *recording, "--out", "here.rlm", "--json", cwd=tmp_path)
    there = roel(
        "map", "build", *recording, "--out", "there.rlm", "--json", "--server", server, cwd=tmp_path
    )
    assert (tmp_path / "here.rlm").read_bytes() == (tmp_path / "there.rlm").read_bytes()
    reports = [json.loads(here), json.loads(there)]
    for key in ("frame_count", "event_count", "line_count", "config", "versions"):
        assert reports[0][key] == reports[1][key]
    assert all(report["peak_rss_mib"] < MAX_MEMORY_MIB for report in reports)
