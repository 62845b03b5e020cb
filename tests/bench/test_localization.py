from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from roel_bench import localization, localization_places, localization_report
from roel_bench.localization import (
    Cell,
    Protocol,
    Trial,
    first_guess,
    off_axes_deg,
    read_results,
    run,
    write_results,
)
from roel_bench.localization_methods import METHODS, Answer, Method
from roel_bench.localization_places import Panorama, Place
from roel_client.cli import bench
from roel_service.errors import InputError
from roel_service.evaluation.poses import rotation_errors_rad, translation_errors_m
from roel_service.geometry.se3 import SE3
from roel_service.progress import ignore
from tests.pano_loc.rooms import FURNITURE, OTHER_FURNITURE, OTHER_ROOM, ROOM, map_of, pose

HERE_POSE = pose(2.0, 1.6, 1.3, 0.1, -0.2, 0.7)


def place(name, kind, room, furniture):
    panoramas = tuple(
        Panorama(name=f"{index}", T_world_panorama=HERE_POSE, read=lambda: np.zeros((2, 4)))
        for index in range(2)
    )
    return Place(name=name, kind=kind, line_map=map_of(room, furniture), panoramas=panoramas)


PLACES = [
    place("room_11", localization_places.ROOM, ROOM, FURNITURE),
    place("other", localization_places.ROOM, OTHER_ROOM, OTHER_FURNITURE),
    place("house", localization_places.HOUSE, ROOM, FURNITURE),
    place("twins", localization_places.SYMMETRIC, ROOM, ()),
]
# Always says the same, near the truth where nothing is moved; takes part like the real one.
OFF = HERE_POSE.retract(np.array([0.01, 0.0, 0.0, 0.03, 0.04, 0.0]))


def oracle(name, calls):
    def prepare(line_map):
        calls.append(len(line_map))
        status = "" if name == "fgpl" else "FOUND"
        answer = Answer(status=status, poses=(OFF,), score=0.5, covariance=np.eye(6) * 1e-4)
        return lambda grey, prior: answer

    return Method(name=name, prepare=prepare)


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    path = tmp_path_factory.mktemp("bench") / "localization.json"
    unjudged = dataclasses.replace(oracle("unjudged", []), kinds=(localization_places.HOUSE,))
    methods = [oracle("default", []), oracle("fgpl", []), unjudged]
    done = run(
        PLACES, [p for p in localization.PROTOCOLS if p.change is None], methods, path, ignore
    )
    assert read_results(path) == done
    return done


def cell(results, *key):
    return next(cell for cell in results.cells if cell.key == key)


def test_errors_and_their_size_against_the_covariance_are_told(results):
    trial = cell(results, "room_11", "here", "default").trials[0]
    assert trial.translation_m == pytest.approx(0.05, abs=1e-5)
    assert trial.rotation_deg == pytest.approx(np.degrees(0.01), abs=1e-3)
    assert trial.nees == pytest.approx((0.01**2 + 0.05**2) / 1e-4 / 6, abs=1e-2)
    assert trial.is_listed
    assert localization_report.is_fine(trial)


def test_moving_the_map_moves_the_truth(results):
    assert not any(
        localization_report.is_coarse(trial)
        for trial in cell(results, "room_11", "moved", "default").trials
    )


def test_protocols_run_where_they_apply(results):
    keys = {cell.key for cell in results.cells}
    assert ("room_11", "elsewhere", "default") in keys
    assert ("room_11", "elsewhere", "fgpl") not in keys
    assert ("house", "elsewhere", "default") not in keys
    assert ("twins", "here", "fgpl") in keys
    assert ("twins", "moved", "fgpl") not in keys
    assert ("house", "here", "unjudged") in keys
    assert ("room_11", "here", "unjudged") not in keys


def test_what_a_file_holds_is_not_run_again(tmp_path):
    path, calls = tmp_path / "r.json", []
    protocols = [Protocol(name="here")]
    run(PLACES[:1], protocols, [oracle("default", calls)], path, ignore)
    first = len(calls)
    run(PLACES[:2], protocols, [oracle("default", calls)], path, ignore)
    assert len(calls) - first == first
    run(PLACES[:2], protocols, [oracle("default", calls)], path, ignore, again=True)
    assert len(calls) - 2 * first == first + 1  # asked once more untimed, then once a place


def test_cells_of_fewer_panoramas_are_run_again(tmp_path):
    path = tmp_path / "r.json"
    for max_count, expected in ((1, 1), (2, 2), (1, 2)):
        protocol = Protocol(name="here", max_count=max_count)
        done = run(PLACES[:1], [protocol], [oracle("default", [])], path, ignore)
        assert len(done.cells[0].trials) == expected


def test_another_files_results_are_refused(tmp_path):
    (tmp_path / "r.json").write_text('{"format": "another"}')
    with pytest.raises(InputError, match="expected roel localization benchmark 1"):
        read_results(tmp_path / "r.json")


def test_the_page_keeps_what_is_written_by_hand(results):
    text = f"before\n{localization_report.BEGIN}stale row\n{localization_report.END}after\n"
    page = localization_report.page(results, text)
    assert page.startswith("before\n<!-- measured")
    assert page.endswith("end of what was measured -->\nafter\n")
    assert "stale row" not in page
    assert "| default | room_11 | 96 | 0.0 | 2 | 100.0 % | 100.0 % | 0.050 | 0.57 |" in page
    assert "| elsewhere | default | 4 | 4 | 0 | 0 | 100.0 % | - |" in page
    assert localization_report.page(results, page) == page


def test_a_trial_without_a_pose_is_not_right():
    trial = Trial(
        panorama="1",
        status="NOT_FOUND",
        rotation_deg=None,
        translation_m=None,
        is_listed=False,
        score=0.1,
        margin=None,
        nees=None,
        seconds=0.1,
        clock_seconds=0.2,
    )
    assert not localization_report.is_coarse(trial)


def test_pictures_of_other_rooms_are_asked_for(results):
    # Both maps are asked for pictures of the other, which the names of panoramas do not tell here.
    asked = localization._asked(PLACES[0], Protocol(name="elsewhere"), PLACES)
    assert asked == PLACES[1].panoramas


def test_first_guesses_are_as_far_off_as_said():
    truth = pose(1.0, 2.0, 3.0, 0.3, 0.2, 0.1)
    guess = first_guess(truth, np.random.default_rng(0))
    assert float(np.degrees(rotation_errors_rad(guess, truth))) == pytest.approx(25.0)
    assert float(translation_errors_m(guess, truth)) == pytest.approx(0.4)


@pytest.mark.parametrize(("yaw_deg", "expected"), [(0.0, 0.0), (17.0, 17.0), (85.0, 5.0)])
def test_how_far_a_map_lies_off_its_axes(yaw_deg, expected):
    turn = pose(1.0, -2.0, 0.5, 0.0, 0.0, np.radians(yaw_deg))
    assert off_axes_deg(map_of().transformed(turn)) == pytest.approx(expected, abs=0.05)


def test_a_place_moves_with_its_panoramas():
    moved = PLACES[0].moved(pose(0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
    assert moved.panoramas[0].T_world_panorama.translation[2] == pytest.approx(2.3)


def test_symmetric_rooms_are_the_same_after_half_a_turn():
    room = localization_places.symmetric_rooms(1)[0]
    ends = room.line_map.segments.reshape(-1, 3)
    turned = ends * [-1.0, -1.0, 1.0]
    distance = np.linalg.norm(ends[:, None] - turned, axis=2).min(axis=1)
    assert distance.max() < 10 * localization_places.SYMMETRIC_NOISE_M
    assert room.kind == localization_places.SYMMETRIC
    picture = room.panoramas[0].read()
    assert picture.shape == (512, 1024)
    assert len(np.unique(picture)) > 4


def test_rooms_of_a_house_hold_their_own_lines_and_photographs(tmp_path):
    segments = np.arange(18.0).reshape(3, 2, 3)
    np.savez(tmp_path / "lines.npz", segments=segments, room=np.array(["a", "b", "a"]))
    poses = "# comment\n3 1 2 3 0 0 0 1 a 0\n4 1 2 3 0 0 0 1 nowhere 0\n"
    (tmp_path / "poses.txt").write_text(poses)
    whole, outside, room = localization_places.house(tmp_path / "lines.npz", tmp_path)
    assert (len(whole.line_map), len(room.line_map)) == (3, 2)
    assert [len(item.panoramas) for item in (whole, outside, room)] == [1, 1, 1]
    np.testing.assert_array_equal(room.panoramas[0].T_world_panorama.translation, [1, 2, 3])


@pytest.mark.parametrize("text", ["", "# nothing\n", "x 1 2 3 0 0 0 1\n", "1 2 3\n"])
def test_poses_that_cannot_be_used_are_refused(tmp_path, text):
    (tmp_path / "poses.txt").write_text(text)
    with pytest.raises(InputError, match=r"poses\.txt"):
        localization_places.room("r", map_of(), tmp_path)


def test_command_line_knows_every_protocol_and_method():
    assert tuple(p.name for p in localization.PROTOCOLS) == bench.LOCALIZATION_PROTOCOLS
    assert tuple(METHODS) == bench.LOCALIZATION_METHODS


def test_pictures_are_changed_as_asked():
    grey = np.arange(2 * 32 * 64, dtype=np.uint8).reshape(32, 128)[:, :64]
    assert localization.resized(32)(grey).shape == (16, 32)
    assert localization.compressed(50)(grey).shape == grey.shape


def test_the_default_is_asked_like_any_other():
    query = METHODS["default"].prepare(map_of())
    answer = query(np.zeros((256, 512), np.uint8), None)
    assert (answer.status, answer.poses) == ("NOT_FOUND", ())


def test_cells_of_one_key_replace_each_other(tmp_path, results):
    old = results.cells[0]
    new = dataclasses.replace(old, prepare_seconds=77.0)
    assert isinstance(new, Cell)
    merged = results.with_cell(new)
    assert len(merged.cells) == len(results.cells)
    write_results(tmp_path / "r.json", merged)
    assert new in read_results(tmp_path / "r.json").cells


def test_identity_is_the_only_motion_by_default():
    (motion,) = Protocol(name="here").motions
    np.testing.assert_array_equal(motion.matrix(), SE3.identity().matrix())


def test_the_committed_page_is_that_of_the_committed_trials():
    text = localization_report.DOCUMENT.read_text(encoding="utf-8")
    assert localization_report.page(read_results(localization_report.RESULTS), text) == text
