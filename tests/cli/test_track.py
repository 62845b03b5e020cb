"""`roel track`."""

import json

import numpy as np
import pytest

from roel_client.cli.main import parser
from roel_client.cli.track import track
from roel_service.errors import NoAnswerError
from roel_service.geometry.se3 import SE3
from roel_service.io.camera import write_camera
from roel_service.io.maps import export_map
from roel_service.io.poses import read_trajectory

from ..tracking.synthetic import CAMERA, recording


@pytest.fixture(scope="module")
def room():
    return recording(seconds=0.25)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, room):
    made = tmp_path_factory.mktemp("walk")
    events = room.events
    np.savez(made / "events.npz", t=events.t_us, x=events.x, y=events.y, p=events.polarity > 0)
    write_camera(made / "camera.json", CAMERA)
    export_map(room.line_map, made / "map.npz")
    np.savetxt(made / "T.txt", room.pose(25_000).matrix())
    elsewhere = SE3(rotation=np.diag([-1.0, 1.0, -1.0]), translation=np.zeros(3))
    np.savetxt(made / "elsewhere.txt", elsewhere.matrix())
    return made


def run(folder, *options, init="T.txt", staged=None):
    files = [str(folder / "map.npz"), "--events", str(folder / "events.npz")]
    files += ["--camera", str(folder / "camera.json"), "--init", str(folder / init)]
    track(parser().parse_args(["track", *files, *options]), staged or {})


def test_poses_are_printed_as_json_lines_and_written(folder, room, tmp_path, capsys):
    out = tmp_path / "poses.txt"
    run(folder, "--out", str(out), "--json", staged={"out": out})
    documents = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [document["t_us"] for document in documents[:2]] == [26_000, 51_000]
    relied_on = [document for document in documents if document["status"] == "TRACKING"]
    written = read_trajectory(out)
    assert written.t_us.tolist() == [document["t_us"] for document in relied_on]
    for document in relied_on:
        true = room.pose(document["t_us"]).matrix()
        # A centimetre, and as much of a radian.
        np.testing.assert_allclose(document["T_world_camera"], true, atol=0.01)
        assert np.shape(document["covariance"]) == (6, 6)


def test_for_people_the_poses_are_counted(folder, capsys):
    run(folder)
    said = capsys.readouterr().out
    assert "poses: " in said
    assert " TRACKING" in said


def test_a_camera_that_is_not_found_is_no_answer(folder):
    with pytest.raises(NoAnswerError) as caught:
        run(folder, init="elsewhere.txt")
    assert caught.value.reason == "NOT_TRACKED"
