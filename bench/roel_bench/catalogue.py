"""The scenes of the benchmark by name, and which of them parameters may be chosen on.

| name | what |
| --- | --- |
| `sim_SEED_WxH_SECONDSs` | simulated room, made once and kept |
| `curved_SEED_WxH_SECONDSs` | simulated room of round things, made once and kept |
| `room_11`, `room_12` | rooms of another simulator, in the folder of recordings |
| `slider_depth`, `events_room01` | real events with poses; events of a photographed room |
| `boxes`, `disk`, `stripes`, `building` | real events without poses |
| `folder:PATH` | any recording laid out as `roel simulate` does |
| `tum_vie:DIR/SEQUENCE`, `vector:DIR/SEQUENCE`, `replica:DIR/SCENE` | see `datasets` |

`tum_vie` and `vector` take a third part, `:POSES`, a file of poses in place of the publisher's.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from roel_bench.datasets import open_replica, open_tum_vie, open_vector
from roel_bench.recordings import read_aedat2, read_event_lifetime
from roel_bench.scenes import HeldBackEvents, LineTruth, MapTruth, Scene, part_of
from roel_service.errors import InputError
from roel_service.io.camera import read_camera
from roel_service.io.clouds import read_mesh, read_points
from roel_service.io.events import open_events, read_events
from roel_service.io.npz import read_npz
from roel_service.io.poses import read_trajectory
from roel_service.progress import ProgressCallback
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventStream
from roel_service.simulate.dataset import SimulationConfig, simulate_dataset

# Parameters were chosen by looking at these, so their rows count in no mean.
TUNING_ROOMS = ("room_11", "room_12")
TUNING_SEEDS = range(101, 110)
CURVED_TUNING_SEEDS = range(301, 310)

LARGE_ROOMS = tuple(f"sim_{seed}_640x480_8s" for seed in range(201, 203))
SMALL_ROOMS = tuple(f"sim_{seed}_346x260_6s" for seed in range(211, 213))
REPORTING_ROOMS = LARGE_ROOMS + SMALL_ROOMS
CURVED_ROOMS = tuple(f"curved_{seed}_346x260_4s" for seed in range(311, 314))
POSED_RECORDINGS = ("slider_depth", "events_room01")
POSELESS_RECORDINGS = ("boxes", "disk", "stripes", "building")
# Small enough for a test, large enough for some lines.
TINY_ROOM = "sim_1_173x130_1s"
# Smaller still; its lines go through every stage all the same.
WARM_UP_ROOM = "sim_1_120x90_0.4s"

SIMULATED_NAME = re.compile(
    r"(?P<kind>sim|curved)_(?P<seed>\d{1,9})_(?P<width>\d{2,4})x(?P<height>\d{2,4})_(?P<seconds>\d{1,3}(\.\d)?)s"
)
SIMULATED_NAMES = ("sim_SEED_WxH_SECONDSs", "curved_SEED_WxH_SECONDSs")
# The scene of each kind of simulated room, and the seeds that parameters were chosen on.
SIMULATED_KINDS = {"sim": ("room", TUNING_SEEDS), "curved": ("curved", CURVED_TUNING_SEEDS)}
# Every so many events one is held back where there is no other truth.
HELD_BACK_STRIDE = 10
DAVIS240_SIZE = (240, 180)


@dataclass(frozen=True, kw_only=True)
class Places:
    """Where scenes are found.

    Attributes:
        data: folder of recordings, or None where there is none.
        rooms: folder that keeps simulated rooms; made when the first one is.
    """

    data: Path | None
    rooms: Path


# Opens a scene; a simulated one is made first if need be.
Opener = Callable[[ProgressCallback], Scene]


def find_scene(name: str, places: Places) -> Opener:
    """How to open the scene of that name.

    Raises:
        InputError: no scene of that name, or no folder to find it in.
    """
    if simulated := SIMULATED_NAME.fullmatch(name):
        return lambda progress: _simulated(name, simulated, places.rooms, progress)
    if name.startswith("folder:"):
        return lambda progress: _folder(name, Path(name.removeprefix("folder:")), is_tuning=False)
    kind, _, place = name.partition(":")
    if kind in DATASETS and place:
        return lambda progress: replace(DATASETS[kind](place), name=name)
    if name not in RECORDINGS:
        published = [f"{kind}:DIR/SEQUENCE" for kind in DATASETS]
        known = ", ".join([*SIMULATED_NAMES, *RECORDINGS, "folder:PATH", *published])
        raise InputError("scene", f"one of {known}", repr(name))
    data = places.data
    if data is None:
        raise InputError(name, "a folder of recordings (--data or ROEL_DATA)", "none")
    return lambda progress: RECORDINGS[name](name, data)


def open_scene(name: str, places: Places, progress: ProgressCallback) -> Scene:
    """The scene of that name, simulated first if need be.

    Raises:
        InputError: as `find_scene`, or files of it that cannot be used.
    """
    return find_scene(name, places)(progress)


def _simulated(
    name: str, arguments: re.Match[str], rooms: Path, progress: ProgressCallback
) -> Scene:
    folder = rooms / name
    seed = int(arguments["seed"])
    scene, tuning_seeds = SIMULATED_KINDS[arguments["kind"]]
    if not folder.exists():
        rooms.mkdir(parents=True, exist_ok=True)
        config = SimulationConfig(
            seconds=float(arguments["seconds"]),
            width=int(arguments["width"]),
            height=int(arguments["height"]),
            panorama_count=0,
            scene=scene,
        )
        simulate_dataset(folder, config, seed, progress)
    return _folder(name, folder, is_tuning=seed in tuning_seeds)


def _folder(name: str, folder: Path, *, is_tuning: bool) -> Scene:
    """A recording laid out as `roel simulate` does; truth and noisy poses may be missing."""
    camera = read_camera(folder / "camera.json")
    noisy, truth = folder / "poses_noisy.txt", folder / "gt.npz"
    return Scene(
        name=name,
        events=open_events(folder / "events.h5", camera.width, camera.height),
        camera=camera,
        trajectory=read_trajectory(folder / "poses.txt"),
        noisy_trajectory=read_trajectory(noisy) if noisy.exists() else None,
        truth=_map_truth(truth) if truth.exists() else None,
        is_tuning=is_tuning,
    )


def _map_truth(path: Path) -> MapTruth:
    """Surfaces, edges, and which of these are round where the archive tells."""
    tells_curves = read_npz(path, ("curved_edges",), str(path), InputError)
    return MapTruth(
        mesh=read_mesh(path),
        edges=read_points(path, "edges"),
        curved_edges=read_points(path, "curved_edges") if tells_curves else None,
    )


def _room(name: str, data: Path) -> Scene:
    return _folder(name, data / "rooms" / name, is_tuning=name in TUNING_ROOMS)


def _photographed_room(name: str, data: Path) -> Scene:
    folder = data / "real" / "zind" / name
    lines = folder / "lines.npz"
    segments = read_npz(lines, ("segments",), str(lines), InputError).get("segments")
    if segments is None or segments.shape[1:] != (2, 3):
        raise InputError(str(lines), "an array segments of shape (L, 2, 3)", "none of that shape")
    scene = _folder(name, folder, is_tuning=False)
    return Scene(
        name=name,
        events=scene.events,
        camera=scene.camera,
        trajectory=scene.trajectory,
        truth=LineTruth(segments=segments),
    )


def _slider(name: str, data: Path) -> Scene:
    """Real events with the poses of a linear slider; every tenth event is held back."""
    folder = data / "real" / "davis_slider_depth"
    events = read_events(folder / "events_chunk.txt", *DAVIS240_SIZE)
    is_held_back = np.arange(len(events)) % HELD_BACK_STRIDE == HELD_BACK_STRIDE - 1
    return Scene(
        name=name,
        events=part_of(events, ~is_held_back),
        camera=read_camera(folder / "calib.txt", DAVIS240_SIZE),
        trajectory=read_trajectory(folder / "groundtruth.txt"),
        truth=HeldBackEvents(events=part_of(events, is_held_back)),
    )


def _poseless(folder: str, file: str, read: Callable[[Path], EventStream]) -> RecordingOpener:
    """Opens a recording without poses; its calibration is unknown, and nothing asks for it."""

    def opened(name: str, data: Path) -> Scene:
        events = read(data / "real" / folder / file)
        camera = Camera(
            width=events.width,
            height=events.height,
            fx_px=float(events.width),
            fy_px=float(events.width),
            cx_px=(events.width - 1) / 2,
            cy_px=(events.height - 1) / 2,
        )
        return Scene(name=name, events=events, camera=camera, trajectory=None)

    return opened


def _published(open_sequence: SequenceOpener) -> Callable[[str], Scene]:
    """Opens DIR/SEQUENCE, or DIR/SEQUENCE:POSES."""

    def opened(place: str) -> Scene:
        sequence, _, poses = place.partition(":")
        path = Path(sequence)
        return open_sequence(path.parent, path.name, poses=Path(poses) if poses else None)

    return opened


class SequenceOpener(Protocol):
    """A function of `datasets` for sequences with poses that may be replaced."""

    def __call__(self, folder: Path, sequence: str, *, poses: Path | None = None) -> Scene: ...


DATASETS: dict[str, Callable[[str], Scene]] = {
    "tum_vie": _published(open_tum_vie),
    "vector": _published(open_vector),
    "replica": lambda place: open_replica(Path(place).parent, Path(place).name),
}

RecordingOpener = Callable[[str, Path], Scene]

RECORDINGS: dict[str, RecordingOpener] = {
    "room_11": _room,
    "room_12": _room,
    "slider_depth": _slider,
    "events_room01": _photographed_room,
    "boxes": _poseless("davis240_aedat2", "IMU_translBoxes.aedat", read_aedat2),
    "disk": _poseless("davis240_aedat2", "IMU_rotDisk.aedat", read_aedat2),
    "stripes": _poseless("rpg_event_lifetime", "stripes.mat", read_event_lifetime),
    "building": _poseless("rpg_event_lifetime", "building.mat", read_event_lifetime),
}
