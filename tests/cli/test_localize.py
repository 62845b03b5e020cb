"""`roel localize`, as the contract has it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from roel_client.cli.localize import METHODS, localize
from roel_client.cli.main import parser
from roel_client.cli.parser import UsageError
from roel_client.local import localization
from roel_service.config.stages import LocalizeConfig
from roel_service.errors import NoAnswerError
from roel_service.evaluation.poses import rotation_errors_rad, translation_errors_m
from roel_service.geometry.se3 import SE3
from roel_service.io.camera import read_camera
from roel_service.io.maps import export_map
from tests.pano_loc.rooms import OTHER_FURNITURE, OTHER_ROOM, map_of, pose, segments_of
from tests.pano_loc.wireframe import wireframe_panorama, wireframe_photograph

ROEL = Path(sys.executable).with_name("roel")
TRUTH = pose(1.7, 1.5, 1.4, 0.05, -0.1, 2.5)
KEYS = {
    "panorama", "status", "T_world_panorama", "score", "covariance", "alternatives", "reason",
    "seconds",
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("localize")
    export_map(map_of(), path / "map.npz")
    cv2.imwrite(str(path / "room.png"), wireframe_panorama(TRUTH, segments_of(), 2048))
    cv2.imwrite(str(path / "black.jpg"), np.zeros((256, 512), np.uint8))
    cv2.imwrite(str(path / "square.png"), np.zeros((512, 512), np.uint8))
    np.savetxt(path / "T.txt", TRUTH.matrix())
    return path


def roel(folder, *arguments):
    command = [ROEL, "localize", "map.npz", *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def test_one_line_of_json_a_panorama_and_one_picture(folder):
    done = roel(folder, "room.png", "black.jpg", "--overlay", "pictures", "--json")
    assert (done.returncode, done.stderr) == (0, "")
    found, lost = (json.loads(line) for line in done.stdout.splitlines())
    assert set(found) == set(lost) == KEYS
    assert (found["panorama"], lost["panorama"]) == ("room.png", "black.jpg")
    assert (found["status"], found["reason"]) == ("FOUND", None)
    estimate = SE3.from_matrix(np.array(found["T_world_panorama"]))
    assert translation_errors_m(estimate, TRUTH) < 0.02
    assert np.degrees(rotation_errors_rad(estimate, TRUTH)) < 0.3
    assert (np.linalg.eigvalsh(np.array(found["covariance"])) > 0).all()
    assert (lost["status"], lost["reason"]) == ("NOT_FOUND", "INSUFFICIENT_LINES")
    assert (lost["T_world_panorama"], lost["covariance"], lost["alternatives"]) == (None, None, [])
    names = sorted(path.name for path in (folder / "pictures").iterdir())
    assert names == ["000-room.png", "001-black.png"]
    overlay = cv2.imread(str(folder / "pictures" / "000-room.png"))
    assert overlay.shape == (1024, 2048, 3)
    # The map's lines are red, and lie on the white ones of the picture.
    red = overlay[..., 2].astype(int) - overlay[..., 0] > 100
    assert red.mean() > 0.01
    assert cv2.imread(str(folder / "room.png"), 0)[red].mean() > 100


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["room.png", "--preset", "paper", "--prior", "T.txt"],
            "roel: error: --preset: expected default, as there is --prior, found paper",
        ),
        (
            ["room.png", "square.png"],
            "roel: error: square.png: expected a width of twice the height",
        ),
        (["map.npz"], "roel: error: map.npz: expected a JPEG or PNG picture, found something else"),
        (["none.png"], "roel: error: none.png: expected a file, found nothing of that name"),
        (["room.png", "--prior", "map.npz"], "roel: error: map.npz: expected"),
    ],
)
def test_unusable_inputs_end_with_2_and_one_line(folder, arguments, message):
    done = roel(folder, *arguments, "--json")
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith(message)


@pytest.mark.parametrize("preset", ["paper", "fgpl-released"])
def test_fgpl_gets_the_same_keys_and_a_verdict(folder, preset):
    (document,) = localization.localize_panoramas(
        [str(folder / "map.npz")],
        [str(folder / "black.jpg")],
        method=METHODS[preset],
        prior=None,
        config=LocalizeConfig(),
        overlay=None,
    )
    assert set(document) == KEYS
    assert (document["status"], document["reason"]) == ("NOT_FOUND", "INSUFFICIENT_LINES")


def test_strict_says_which_panorama_and_why(folder, monkeypatch):
    monkeypatch.chdir(folder)
    options = parser().parse_args(["localize", "map.npz", "black.jpg", "--strict"])
    with pytest.raises(NoAnswerError) as caught:
        localize(options, {})
    assert caught.value.reason == "NOT_LOCATED"
    assert str(caught.value).startswith("black.jpg: ")


def test_strict_ends_with_3_and_still_prints_the_results(folder):
    done = roel(folder, "black.jpg", "--strict", "--json")
    assert done.returncode == 3
    assert json.loads(done.stdout)["status"] == "NOT_FOUND"
    (line,) = done.stderr.splitlines()
    assert line.startswith("roel: no answer: black.jpg: ")
    assert "INSUFFICIENT_LINES" in line


def test_the_map_that_holds_the_place_is_named(folder, monkeypatch, capsys):
    export_map(map_of(OTHER_ROOM, OTHER_FURNITURE), folder / "other.npz")
    monkeypatch.chdir(folder)
    options = ["localize", "other.npz", "room.png", "black.jpg", "--map", "map.npz", "--json"]
    localize(parser().parse_args(options), {})
    found, lost = (json.loads(line) for line in capsys.readouterr().out.splitlines())
    assert set(found) == set(lost) == KEYS | {"map"}
    assert (found["status"], found["map"]) == ("FOUND", "map.npz")
    assert (lost["status"], lost["map"]) == ("NOT_FOUND", None)


def test_photographs_need_their_camera_and_a_first_pose(folder, monkeypatch, capsys):
    camera = {"width": 640, "height": 480, "fx": 420, "fy": 420, "cx": 319.5, "cy": 239.5}
    (folder / "camera.json").write_text(
        json.dumps(camera | {"model": "pinhole", "distortion": []}), encoding="utf-8"
    )
    ahead = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    truth = SE3(rotation=TRUTH.rotation @ ahead, translation=TRUTH.translation)
    np.savetxt(folder / "T_camera.txt", truth.matrix())
    photograph = wireframe_photograph(truth, segments_of(), read_camera(folder / "camera.json"))
    cv2.imwrite(str(folder / "photo.png"), photograph)
    monkeypatch.chdir(folder)
    options = ["localize", "map.npz", "photo.png", "--camera", "camera.json", "--json"]
    with pytest.raises(UsageError, match="--camera: expected a first pose"):
        localize(parser().parse_args(options), {})
    options += ["--prior", "T_camera.txt"]
    with pytest.raises(UsageError, match="--server: expected panoramas"):
        localize(parser().parse_args([*options, "--server", "localhost:1"]), {})
    localize(parser().parse_args(options), {})
    found = json.loads(capsys.readouterr().out)
    estimate = SE3.from_matrix(np.array(found["T_world_panorama"]))
    assert translation_errors_m(estimate, truth) < 0.05


def test_a_prior_is_read_and_the_pose_printed_for_people(folder):
    done = roel(folder, "room.png", "--prior", "T.txt")
    assert done.returncode == 0
    head, *rows = done.stdout.splitlines()
    assert head.startswith("room.png: FOUND, score ")
    np.testing.assert_allclose(
        np.array([row.split() for row in rows], float), TRUTH.matrix(), atol=0.02
    )
