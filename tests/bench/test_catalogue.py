import shutil

import pytest

from roel_bench import catalogue
from roel_bench.catalogue import (
    POSED_RECORDINGS,
    POSELESS_RECORDINGS,
    TUNING_ROOMS,
    Places,
    open_scene,
)
from roel_bench.scenes import HeldBackEvents, LineTruth, MapTruth
from roel_service.errors import InputError
from roel_service.progress import ignore
from roel_service.scene.events import concatenate

ROOM = "sim_3_32x24_0.1s"


@pytest.fixture(scope="module")
def places(rooms):
    return Places(data=None, rooms=rooms / "of_their_own")


def test_rooms_are_simulated_once(places):
    scene = open_scene(ROOM, places, ignore)
    assert (scene.name, scene.sensor, scene.is_tuning) == (ROOM, "32x24", False)
    assert isinstance(scene.truth, MapTruth)
    assert scene.noisy_trajectory is not None
    kept = (places.rooms / ROOM / "events.h5").stat().st_mtime_ns
    open_scene(ROOM, places, ignore)
    assert (places.rooms / ROOM / "events.h5").stat().st_mtime_ns == kept


def test_folders_of_that_layout_are_scenes_even_without_truth(places, tmp_path):
    open_scene(ROOM, places, ignore)
    folder = tmp_path / "mine"
    shutil.copytree(places.rooms / ROOM, folder)
    name = f"folder:{folder}"
    assert isinstance(open_scene(name, places, ignore).truth, MapTruth)
    (folder / "gt.npz").unlink()
    (folder / "poses_noisy.txt").unlink()
    scene = open_scene(name, places, ignore)
    assert (scene.truth, scene.noisy_trajectory) == (None, None)


def test_rooms_of_tuning_seeds_are_marked(places):
    name = "sim_101_32x24_0.1s"
    open_scene(ROOM, places, ignore)
    # Not simulated once more: what is there is taken.
    shutil.copytree(places.rooms / ROOM, places.rooms / name)
    assert open_scene(name, places, ignore).is_tuning


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("nope", "one of sim_SEED"),
        ("sim_1_32x24", "one of sim_SEED"),
        ("room_12", "--data or ROEL_DATA"),
        ("folder:/nowhere", "camera.json"),
        ("vector:", "one of sim_SEED"),
        ("vector:/nowhere/desk-fast", "/nowhere/"),
        ("vector:/nowhere/desk-fast:devo.txt", "/nowhere/|devo.txt"),
        ("tum_vie:/nowhere/mocap-desk", "/nowhere/"),
        ("replica:/nowhere/office4", "/nowhere/"),
    ],
)
def test_scenes_that_are_not_there(places, name, expected):
    with pytest.raises(InputError, match=expected):
        open_scene(name, places, ignore)


@pytest.mark.data
@pytest.mark.parametrize("name", [*TUNING_ROOMS, *POSED_RECORDINGS, *POSELESS_RECORDINGS])
def test_recordings_open(data_folder, tmp_path, name):
    scene = open_scene(name, Places(data=data_folder, rooms=tmp_path), ignore)
    assert scene.name == name
    assert scene.is_tuning == (name in TUNING_ROOMS)
    assert (scene.trajectory is None) == (name in POSELESS_RECORDINGS)
    assert len(next(scene.events.chunks())) > 10_000


@pytest.mark.data
def test_truth_of_recordings(data_folder, tmp_path):
    places = Places(data=data_folder, rooms=tmp_path)
    room = open_scene("events_room01", places, ignore)
    assert isinstance(room.truth, LineTruth)
    assert room.truth.segments.shape == (24, 2, 3)
    slider = open_scene("slider_depth", places, ignore)
    assert isinstance(slider.truth, HeldBackEvents)
    kept = concatenate(list(slider.events.chunks()))
    assert len(slider.truth.events) == pytest.approx(len(kept) / 9, abs=1)


def test_published_sequences_are_named_by_folder_and_poses(places, monkeypatch):
    asked = []

    def opened(place):
        asked.append(place)
        return open_scene(ROOM, places, ignore)

    monkeypatch.setitem(catalogue.DATASETS, "vector", opened)
    scene = open_scene("vector:a/b:c", places, ignore)
    assert asked == ["a/b:c"]
    assert scene.name == "vector:a/b:c"
