"""The installed `roel`, as scripts meet it: exit codes, streams and files."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pytest

from roel_service.arrays import Array

ROEL = Path(sys.executable).with_name("roel")
WIDTH, HEIGHT = 64, 48
DURATION_US = 400_000


@dataclass(frozen=True, kw_only=True)
class Recording:
    """A small recording in which nothing but noise happens."""

    folder: Path

    def write_events(self, columns: dict[str, Array]) -> None:
        with h5py.File(self.folder / "events.h5", "w") as file:
            for name, column in columns.items():
                file[f"events/{name}"] = column

    def write_poses(self, change: Callable[[Array], None] = lambda poses: None) -> None:
        """Poses (t tx ty tz qx qy qz qw) along x, without rotation, after `change`."""
        poses = np.zeros((41, 8))
        poses[:, 0] = np.linspace(0.0, 0.4, 41)
        poses[:, 1] = np.linspace(0.0, 0.1, 41)
        poses[:, 7] = 1.0
        change(poses)
        np.savetxt(self.folder / "poses.txt", poses)

    def build(self, *options: str) -> subprocess.CompletedProcess[str]:
        inputs = ("--events", "events.h5", "--poses", "poses.txt", "--camera", "camera.json")
        return roel("map", "build", *inputs, "--out", "map.rlm", *options, cwd=self.folder)


def roel(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    environment = {key: value for key, value in os.environ.items() if key != "ROEL_LOG_LEVEL"}
    return subprocess.run(
        [ROEL, *arguments], cwd=cwd, env=environment, capture_output=True, text=True, check=False
    )


def noise() -> dict[str, Array]:
    """Columns of events that are spread evenly and hold no line."""
    rng = np.random.default_rng(0)
    count = 4_000
    return {
        "t": np.sort(rng.integers(0, DURATION_US, count)),
        "x": rng.integers(0, WIDTH, count, dtype=np.uint16),
        "y": rng.integers(0, HEIGHT, count, dtype=np.uint16),
        "p": rng.integers(0, 2, count, dtype=np.uint8),
    }


@pytest.fixture
def recording(tmp_path: Path) -> Recording:
    made = Recording(folder=tmp_path)
    made.write_events(noise())
    made.write_poses()
    intrinsics = {"fx": 50.0, "fy": 50.0, "cx": 31.5, "cy": 23.5}
    camera = {"width": WIDTH, "height": HEIGHT, **intrinsics, "model": "pinhole", "distortion": []}
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    return made


def truncate_events(recording: Recording) -> None:
    path = recording.folder / "events.h5"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def swap_two_times(recording: Recording) -> None:
    columns = noise()
    columns["t"][[2_000, 2_001]] = columns["t"][[2_001, 1_000]]
    recording.write_events(columns)


def move_event_off_the_sensor(recording: Recording) -> None:
    columns = noise()
    columns["x"][7] = WIDTH
    recording.write_events(columns)


def set_pose_nan(recording: Recording) -> None:
    def change(poses: Array) -> None:
        poses[3, 2] = np.nan

    recording.write_poses(change)


def stretch_quaternion(recording: Recording) -> None:
    def change(poses: Array) -> None:
        poses[3, 7] = 1.1

    recording.write_poses(change)


def shift_poses_away(recording: Recording) -> None:
    def change(poses: Array) -> None:
        poses[:, 0] += 0.38

    recording.write_poses(change)


@pytest.mark.parametrize(
    ("spoil", "name", "detail"),
    [
        (truncate_events, "events.h5", ""),
        (swap_two_times, "events.h5", "2001"),
        (move_event_off_the_sensor, "events.h5", "event 7"),
        (set_pose_nan, "poses.txt", "line 4"),
        (stretch_quaternion, "poses.txt", "line 4"),
        (shift_poses_away, "poses.txt", "%"),
    ],
)
def test_unusable_input_is_one_line_that_says_what_and_where(
    recording: Recording, spoil: Callable[[Recording], None], name: str, detail: str
) -> None:
    spoil(recording)
    (recording.folder / "map.rlm").write_text("old")
    done = recording.build("--report", "report.json", "--json")
    assert done.returncode == 2, done.stderr
    assert done.stdout == ""
    line = done.stderr.removesuffix("\n")
    assert "\n" not in line
    assert line.startswith(f"roel: error: {name}: expected ")
    assert ", found " in line
    assert detail in line
    assert (recording.folder / "map.rlm").read_text() == "old"
    assert sorted(os.listdir(recording.folder)) == [
        "camera.json",
        "events.h5",
        "map.rlm",
        "poses.txt",
    ]


def test_recording_without_lines_has_no_answer(recording: Recording) -> None:
    done = recording.build()
    assert done.returncode == 3, done.stderr
    assert done.stdout == ""
    assert done.stderr.startswith("roel: no answer: ")
    assert done.stderr.count("\n") == 1
    assert not (recording.folder / "map.rlm").exists()


def test_report_of_a_build_without_answer_is_printed_as_json(recording: Recording) -> None:
    done = recording.build("--json")
    assert done.returncode == 3, done.stderr
    report = json.loads(done.stdout)
    assert report["line_count"] < 3
    assert report["event_count"] > 0
    assert not (recording.folder / "map.rlm").exists()


@pytest.mark.slow
def test_server_answers_as_the_local_build_does(recording: Recording, server: str) -> None:
    assert roel("health", "--server", server, cwd=recording.folder).stdout == "SERVING\n"
    done = recording.build("--server", server)
    local = recording.build()
    assert (done.returncode, done.stdout, done.stderr) == (3, "", local.stderr)
    told = json.loads(recording.build("--server", server, "--json").stdout)
    assert told["line_count"] < 3
    move_event_off_the_sensor(recording)
    assert recording.build("--server", server).stderr == recording.build().stderr
    assert not (recording.folder / "map.rlm").exists()


def test_server_that_is_not_there_is_one_line(recording: Recording) -> None:
    done = recording.build("--server", "127.0.0.1:9")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("roel: error: 127.0.0.1:9: expected ")
    assert done.stderr.count("\n") == 1


def test_printed_configuration_is_a_valid_configuration(tmp_path: Path) -> None:
    first = roel("config", "show", "--preset", "paper", cwd=tmp_path)
    (tmp_path / "paper.toml").write_text(first.stdout)
    second = roel("config", "show", "--config", "paper.toml", cwd=tmp_path)
    assert tomllib.loads(first.stdout)
    assert (second.returncode, second.stdout) == (0, first.stdout)


def test_unknown_key_of_a_configuration_is_named_with_its_file(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "my.toml").write_text("[trim]\nmax_gapp_m = 1.0\n")
    done = roel("config", "show", "--config", "sub/my.toml", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr == (
        "roel: error: sub/my.toml: expected one of trim.max_gap_m, found trim.max_gapp_m\n"
    )


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_ends_a_long_command_and_leaves_nothing(tmp_path: Path, number: int) -> None:
    command = subprocess.Popen(
        [ROEL, "simulate", "--out", "room", "--seed", "1", "--seconds", "600"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        while not os.listdir(tmp_path):  # until it has begun to write
            assert command.poll() is None
        command.send_signal(number)
        stdout, stderr = command.communicate(timeout=60)
    finally:
        command.kill()
        command.wait()
    assert (command.returncode, stdout, stderr) == (128 + number, "", "")
    assert os.listdir(tmp_path) == []
