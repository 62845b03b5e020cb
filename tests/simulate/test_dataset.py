import json
import math
from dataclasses import replace

import cv2
import h5py
import numpy as np
import pytest
import trimesh

from roel_service.errors import Cancelled, ConfigError, InputError, MeshError
from roel_service.io.camera import read_camera
from roel_service.io.clouds import read_mesh, read_points
from roel_service.io.events import read_events
from roel_service.io.poses import read_trajectory
from roel_service.simulate.dataset import (
    MAX_TILT_RAD,
    STAGES,
    SimulationConfig,
    picture_times,
    simulate_dataset,
)
from roel_service.simulate.motion import walk_in_room
from roel_service.simulate.rooms import furnished_room
from roel_service.simulate.sensor import SensorModel

SMALL = SimulationConfig(seconds=0.15, width=64, height=48, panorama_count=4, panorama_width=128)
DURATION_US = 150_000
FILES = {
    "camera.json",
    "cloud.npz",
    "events.h5",
    "gt.npz",
    "poses.txt",
    "poses_noisy.txt",
    *(f"panos/{index:03d}.jpg" for index in range(4)),
    "panos/poses.txt",
}


def contents(folder):
    """Bytes of every file by its name in the folder."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A small room with the progress that was told."""
    folder = tmp_path_factory.mktemp("made") / "room"
    steps = []
    event_count = simulate_dataset(folder, SMALL, 3, steps.append)
    return folder, event_count, steps


def test_the_folder_holds_exactly_the_files_of_a_recording(made):
    folder, _, _ = made
    assert set(contents(folder)) == FILES
    assert [path.name for path in folder.parent.iterdir()] == ["room"]


def test_equal_arguments_give_equal_bytes(made, tmp_path):
    folder, _, _ = made
    simulate_dataset(tmp_path / "same", SMALL, 3)
    assert contents(tmp_path / "same") == contents(folder)


def test_another_trajectory_seed_walks_through_the_same_scene(made, tmp_path):
    folder, _, _ = made
    simulate_dataset(tmp_path / "second", replace(SMALL, trajectory_seed=9), 3)
    first, second = (np.load(path / "gt.npz") for path in (folder, tmp_path / "second"))
    np.testing.assert_array_equal(first["triangles"], second["triangles"])
    walks = [read_trajectory(path / "poses.txt") for path in (folder, tmp_path / "second")]
    apart_m = walks[0].T_world_camera.translation - walks[1].T_world_camera.translation
    assert np.linalg.norm(apart_m, axis=1).min() > 0.05


def test_another_seed_gives_another_recording_in_a_folder_that_was_empty(made, tmp_path):
    folder, _, _ = made
    (tmp_path / "other").mkdir()
    simulate_dataset(tmp_path / "other", replace(SMALL, seconds=0.02, panorama_count=0), 4)
    three, four = contents(folder), contents(tmp_path / "other")
    # Poses are compared where both have them.
    lines = [files["poses.txt"].splitlines()[1:4] for files in (three, four)]
    assert lines[0] != lines[1]
    assert all(three[name] != four[name] for name in ("gt.npz", "cloud.npz", "events.h5"))


def test_the_readers_read_what_was_written(made):
    folder, event_count, _ = made
    camera = read_camera(folder / "camera.json")
    assert camera == SMALL.camera
    events = read_events(folder / "events.h5", camera.width, camera.height)
    assert len(events) == event_count > 0
    assert events.t_us[0] >= 0
    assert events.t_us[-1] <= DURATION_US
    assert set(events.polarity) == {-1, 1}
    for name in ("poses.txt", "poses_noisy.txt"):
        assert read_trajectory(folder / name).covers(events.t_us).all()
    mesh = read_mesh(folder / "gt.npz")
    assert len(mesh) > 500
    edges = read_points(folder / "gt.npz", "edges")
    cloud = read_points(folder / "cloud.npz", "points")
    low, high = mesh.triangles.reshape(-1, 3).min(axis=0), mesh.triangles.reshape(-1, 3).max(axis=0)
    # Edges are voxels of 5 mm times the room's size over 5 m; the cloud has noise of 5 mm.
    for points, margin_m in ((edges.points, 0.01), (cloud.points, 0.04)):
        assert (points > low - margin_m).all()
        assert (points < high + margin_m).all()
    assert len(cloud) > len(edges) > 100


def test_events_are_indexed_by_milliseconds(made):
    folder, _, _ = made
    with h5py.File(folder / "events.h5") as file:
        t_us, index = file["events/t"][:].astype(np.int64), file["ms_to_idx"][:]
    for millisecond in (0, 1, 37, 149):
        assert index[millisecond] == np.searchsorted(t_us, 1000 * millisecond)


def test_the_camera_has_the_field_of_view_asked_for(made):
    folder, _, _ = made
    camera = json.loads((folder / "camera.json").read_text())
    angle_rad = 2 * math.atan(0.5 * camera["width"] / camera["fx"])
    assert math.degrees(angle_rad) == pytest.approx(SMALL.fov_deg, abs=1e-9)
    assert (camera["cx"], camera["cy"]) == (31.5, 23.5)


def test_panoramas_are_whole_and_every_fourth_is_tilted(made):
    folder, _, _ = made
    rows = np.loadtxt(folder / "panos" / "poses.txt")
    assert rows[:, 0].tolist() == [0, 1, 2, 3]
    mesh = read_mesh(folder / "gt.npz").triangles.reshape(-1, 3)
    clearance_m = np.minimum(rows[:, 1:4] - mesh.min(axis=0), mesh.max(axis=0) - rows[:, 1:4])
    assert clearance_m.min() > 0.5
    x, y = rows[:, 4], rows[:, 5]
    # Angle between the panorama's up and the world's, from its quaternion.
    tilt_rad = np.arccos(1 - 2 * (x**2 + y**2))
    np.testing.assert_allclose(tilt_rad[:3], 0.0, atol=1e-6)
    assert 0.0 < tilt_rad[3] <= MAX_TILT_RAD
    for index in range(4):
        image = cv2.imread(str(folder / "panos" / f"{index:03d}.jpg"))
        assert image.shape == (64, 128, 3)
        assert image.std() > 10


def test_progress_rises_through_all_stages(made):
    _, _, steps = made
    assert list(dict.fromkeys(step.stage for step in steps)) == list(STAGES)
    fractions = [step.fraction for step in steps]
    assert fractions == sorted(fractions)
    assert fractions[0] < 0.1
    assert fractions[-1] <= 1.0


def test_an_edge_moves_less_than_a_pixel_between_pictures():
    rng = np.random.default_rng(0)
    room = furnished_room(rng)
    motion = walk_in_room(room.bounds_m, rng)
    times_us = picture_times(room, motion, SimulationConfig().camera, 200_000)
    assert times_us[0] == 0
    assert times_us[-1] == 200_000
    poses = motion.poses(times_us)
    turn = np.swapaxes(poses.rotation[:-1], -1, -2) @ poses.rotation[1:]
    angle_rad = np.linalg.norm(turn - np.eye(3), axis=(1, 2)) / np.sqrt(2)
    # Turning alone moves the middle of the picture by focal length times angle.
    assert (angle_rad * SimulationConfig().camera.focal_px).max() < 1.0


def test_the_cube_and_a_mesh_take_the_place_of_the_room(tmp_path):
    short = {"seconds": 0.02, "width": 64, "height": 48, "panorama_count": 1, "panorama_width": 64}
    simulate_dataset(tmp_path / "cube", SimulationConfig(scene="cube", **short), 0)
    cube = read_mesh(tmp_path / "cube" / "gt.npz").triangles
    np.testing.assert_allclose(np.abs(cube).max(axis=(0, 1)), 5.0)
    poses = read_trajectory(tmp_path / "cube" / "poses.txt").T_world_camera
    distance = np.linalg.norm(poses.translation, axis=1)
    # The tremor is 2 % of the distance in each axis.
    np.testing.assert_allclose(distance, 25.0, atol=2.5)

    path = tmp_path / "hall.ply"
    hall = trimesh.creation.box((6.0, 5.0, 3.0))
    hall.visual.face_colors = np.random.default_rng(0).integers(40, 250, size=(12, 4))
    hall.export(path)
    simulate_dataset(tmp_path / "hall", SimulationConfig(mesh=path, **short), 0)
    assert len(read_mesh(tmp_path / "hall" / "gt.npz")) == 12


def distance_from_bar_px(events, poses, camera, face, along):
    """(K,) signed distances of events from the bar in the middle of a face; infinite beyond it.

    The bar of the face 5 * `face` runs along `along`; both are (3,).
    """
    T_camera_world = poses.interpolate(events.t_us).inverse()
    # Short of the face's rim.
    ends = [
        T_camera_world @ np.tile(5 * face + reach * along, (len(events), 1)) for reach in (-4, 4)
    ]
    begin_px, end_px = ((end @ camera.matrix.T)[:, :2] / end[:, 2:] for end in ends)
    run_px = end_px - begin_px
    length_px = np.linalg.norm(run_px, axis=1)
    place_px = np.stack([events.x, events.y], axis=-1) - begin_px
    share = np.sum(place_px * run_px, axis=1) / length_px**2
    across_px = (place_px[:, 1] * run_px[:, 0] - place_px[:, 0] * run_px[:, 1]) / length_px
    # The middle belongs to the crossing bar.
    beside = (share < 0) | (share > 1) | (np.abs(share - 0.5) < 0.05)
    return np.where(beside, np.inf, across_px)


@pytest.mark.parametrize("seed", [0, 2])
def test_events_lie_on_the_true_edges_by_the_written_poses(tmp_path, seed):
    quiet = SensorModel(shot_noise_hz=0.0, hot_pixel_share=0.0)
    config = SimulationConfig(
        seconds=0.2, width=160, height=120, fov_deg=30.0, panorama_count=0, scene="cube",
        sensor=quiet,
    )  # fmt: skip
    simulate_dataset(tmp_path / "cube", config, seed)
    camera = read_camera(tmp_path / "cube" / "camera.json")
    poses = read_trajectory(tmp_path / "cube" / "poses.txt")
    events = read_events(tmp_path / "cube" / "events.h5", camera.width, camera.height)
    eye = poses.T_world_camera.translation.mean(axis=0)
    axis = int(np.argmax(np.abs(eye)))
    face = np.sign(eye[axis]) * np.eye(3)[axis]
    middles_px = []
    for along in np.delete(np.eye(3), axis, axis=0):
        distance_px = distance_from_bar_px(events, poses, camera, face, along)
        # A bar is 0.3 wide and some 20 away: its rims are 2.3 px to either side, or less aslant.
        rims_px = [
            distance_px[(side * distance_px > 0) & (side * distance_px < 5.0)] for side in (-1, 1)
        ]
        if min(len(rim_px) for rim_px in rims_px) > 300:
            middles_px.append(np.mean([rim_px.mean() for rim_px in rims_px]))
    # The rims have opposite contrast and move alike: what the logarithm (below 0.1 px) and the wait
    # for the threshold do to one of them, the other undoes, up to 1/12 px of the renderer's samples
    # and 0.02 px of perspective. Half a pixel of a wrong centre would stay, and so would poses at
    # wrong times.
    assert len(middles_px) > 0
    assert np.abs(middles_px).max() < 0.15


@pytest.mark.parametrize("stage", STAGES)
def test_cancelling_leaves_nothing(tmp_path, stage):
    def stop(step):
        if step.stage == stage:
            raise Cancelled

    config = SimulationConfig(
        seconds=0.01, width=32, height=24, panorama_count=1, panorama_width=64
    )
    with pytest.raises(Cancelled):
        simulate_dataset(tmp_path / "room", config, 0, stop)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_in_use_is_refused_and_untouched(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    for target in (tmp_path, tmp_path / "mine.txt"):
        with pytest.raises(InputError) as caught:
            simulate_dataset(target, SMALL, 0)
        assert caught.value.subject == str(target)
    assert contents(tmp_path) == {"mine.txt": b"mine"}


def test_a_folder_that_cannot_be_made_is_refused(tmp_path):
    with pytest.raises(InputError) as caught:
        simulate_dataset(tmp_path / "none" / "room", SMALL, 0)
    assert caught.value.subject == str(tmp_path / "none" / "room")


def test_a_mesh_that_cannot_be_used_leaves_nothing(tmp_path):
    with pytest.raises(MeshError):
        simulate_dataset(tmp_path / "room", SimulationConfig(mesh=tmp_path / "none.glb"), 0)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("seconds", 0.0),
        ("seconds", math.nan),
        ("seconds", math.inf),
        ("width", 0),
        ("height", -3),
        ("height", 100_000),
        ("fov_deg", 180.0),
        ("panorama_count", -1),
        ("scene", "moon"),
    ],
)
def test_values_out_of_range_are_refused_by_name(name, value):
    with pytest.raises(ConfigError, match=name):
        SimulationConfig(**{name: value})
