"""`roel register`, as the contract has it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from roel_client.cli.main import parser
from roel_client.cli.register import register
from roel_service.errors import NoAnswerError
from roel_service.geometry.se3 import rotation_from_vector
from roel_service.io.clouds import write_npz
from roel_service.io.maps import export_map
from tests.register.rooms import room_cloud, room_map

ROEL = Path(sys.executable).with_name("roel")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("register")
    export_map(room_map(), path / "map.npz")
    write_npz(path / "cloud.npz", points=room_cloud(count=40_000).points)
    T = np.eye(4)
    T[:3, :3] = rotation_from_vector(np.array([0.02, 0.0, 0.05]))
    np.savetxt(path / "T.txt", T)
    return path


def roel(folder, *arguments):
    command = [ROEL, "register", "map.npz", "cloud.npz", *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def test_json_has_the_keys_and_values_of_the_contract(folder):
    done = roel(folder, "--init", "T.txt", "--plot", "p.png", "--json")
    assert (done.returncode, done.stderr) == (0, "")
    (line,) = done.stdout.splitlines()
    found = json.loads(line)
    T, information = np.array(found["T_target_source"]), np.array(found["information"])
    np.testing.assert_allclose(T, np.eye(4), atol=0.005)
    assert information.shape == (6, 6)
    assert (np.linalg.eigvalsh(information) > 0).all()
    assert found["converged"] is True
    assert found["verdict"] == "ACCEPTED"
    assert 0.9 < found["fitness"] <= 1.0
    assert 0.0 < found["inlier_rmse_m"] < 0.05
    assert found["seconds"] > 0.0
    assert (folder / "p.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--method", "global", "--init", "T.txt"], "roel: error: --init: expected no first guess"),
        (
            ["--method", "icp"],
            "roel: error: --method: expected one of auto, point, plane, line, glo",
        ),
        (["--init", "map.npz"], "roel: error: map.npz: expected finite numbers"),
        (["--plot", "p.jpg"], "roel: error: --plot: expected a file name that ends in .png"),
    ],
)
def test_unusable_options_end_with_2_and_one_line(folder, arguments, message):
    done = roel(folder, *arguments)
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith(message)


def test_strict_says_why(folder, monkeypatch):
    monkeypatch.chdir(folder)
    np.savetxt("far.txt", np.eye(4) + 9.0 * np.eye(4, k=3))
    line = [
        "register",
        "map.npz",
        "cloud.npz",
        "--method",
        "plane",
        "--init",
        "far.txt",
        "--strict",
    ]
    options = parser().parse_args(line)
    with pytest.raises(NoAnswerError) as caught:
        register(options, {})
    assert caught.value.reason == "NOT_REGISTERED"


def test_strict_ends_with_3_and_still_prints_the_result(folder):
    np.savetxt(
        folder / "far.txt", np.array([[1, 0, 0, 9], [0, 1, 0, 9], [0, 0, 1, 9], [0, 0, 0, 1]])
    )
    done = roel(folder, "--method", "plane", "--init", "far.txt", "--strict", "--json")
    assert done.returncode == 3
    assert json.loads(done.stdout)["verdict"] == "REJECTED"
    (line,) = done.stderr.splitlines()
    assert line.startswith("roel: no answer: map.npz: expected a registration to rely on")
