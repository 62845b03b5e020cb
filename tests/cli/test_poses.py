"""`roel refine-poses`, and the poses of `roel map build`."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from roel_service.config.load import to_toml
from roel_service.io.maps import export_map
from roel_service.io.poses import read_trajectory, write_trajectory
from roel_service.scene.lines import LineMap

from ..mapping.synthetic import CAMERA, SEGMENTS_WORLD, event_stream
from ..mapping.test_pipeline import CONFIG
from ..mapping.test_refine_poses import noisy_trajectory

ROEL = Path(sys.executable).with_name("roel")
INPUTS = ("--events", "events.npz", "--poses", "poses.txt", "--camera", "camera.json")
KEYS = [
    "pose_count",
    "line_count",
    "iterations",
    "converged",
    "cost_initial",
    "cost_final",
    "mean_shift_m",
    "mean_turn_deg",
    "time_offset_us",
    "time_offset_sigma_us",
    "focal_scale",
    "focal_scale_sigma",
    "focal_is_applied",
    "principal_x_shift_px",
    "principal_x_sigma_px",
    "principal_x_is_applied",
    "principal_y_shift_px",
    "principal_y_sigma_px",
    "principal_y_is_applied",
    "problems",
    "seconds",
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of the small world with noisy poses, and the world as a map."""
    made = tmp_path_factory.mktemp("recording")
    events = event_stream()
    np.savez(made / "events.npz", t=events.t_us, x=events.x, y=events.y, p=events.polarity > 0)
    write_trajectory(made / "poses.txt", noisy_trajectory())
    camera = {
        "width": CAMERA.width,
        "height": CAMERA.height,
        "fx": CAMERA.fx_px,
        "fy": CAMERA.fy_px,
        "cx": CAMERA.cx_px,
        "cy": CAMERA.cy_px,
        "model": "pinhole",
        "distortion": [],
    }
    (made / "camera.json").write_text(json.dumps(camera))
    (made / "small.toml").write_text(to_toml(CONFIG))
    export_map(LineMap.from_segments(SEGMENTS_WORLD), made / "map.npz")
    return made


def roel(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {key: value for key, value in os.environ.items() if key != "ROEL_LOG_LEVEL"}
    return subprocess.run(
        [ROEL, *arguments], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize("given", [(), ("--map", "map.npz")], ids=["own lines", "map"])
def test_poses_are_written_at_their_own_times(folder: Path, given: tuple[str, ...]) -> None:
    pictures = ("--plot", "poses.png", "--truth", "poses.txt")
    options = ("--out", "refined.txt", "--config", "small.toml", *pictures, "--json")
    done = roel(folder, "refine-poses", *INPUTS, *given, *options)
    assert (done.returncode, done.stderr) == (0, "")
    result = json.loads(done.stdout)
    assert list(result) == KEYS
    refined, before = read_trajectory(folder / "refined.txt"), read_trajectory(folder / "poses.txt")
    np.testing.assert_array_equal(refined.t_us, before.t_us)
    assert result["pose_count"] == len(before)
    moved = refined.T_world_camera.translation - before.T_world_camera.translation
    assert result["mean_shift_m"] == pytest.approx(np.linalg.norm(moved, axis=1).mean(), rel=1e-6)
    assert result["cost_final"] < result["cost_initial"]
    assert (folder / "poses.png").read_bytes().startswith(b"\x89PNG")


def test_a_build_writes_the_poses_that_it_refined(folder: Path) -> None:
    options = ("--config", "small.toml", "--refine-poses", "--poses-out", "built.txt", "--json")
    done = roel(folder, "map", "build", *INPUTS, "--out", "built.rlm", *options)
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(done.stdout)["config"]["refine"]["free_poses"] is True
    before, refined = read_trajectory(folder / "poses.txt"), read_trajectory(folder / "built.txt")
    np.testing.assert_array_equal(refined.t_us, before.t_us)
    assert (refined.T_world_camera.translation != before.T_world_camera.translation).any()


def test_poses_to_write_need_poses_to_refine(folder: Path) -> None:
    out = ("--out", "none.rlm", "--poses-out", "none.txt")
    done = roel(folder, "map", "build", *INPUTS, *out)
    assert (done.returncode, done.stdout) == (2, "")
    expected = "--poses-out: expected --refine-poses beside it"
    assert done.stderr.startswith(f"roel: error: {expected}")
    assert not (folder / "none.txt").exists()


def test_poses_without_lines_have_no_answer(folder: Path) -> None:
    (folder / "blind.toml").write_text("[detect]\nmin_length_px = 500.0\n")
    done = roel(folder, "refine-poses", *INPUTS, "--out", "none.txt", "--config", "blind.toml")
    assert (done.returncode, done.stdout) == (3, "")
    assert done.stderr == "roel: no answer: poses.txt: expected at least 6 lines in view, found 0\n"
    assert not (folder / "none.txt").exists()
