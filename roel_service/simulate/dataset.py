"""A whole synthetic recording with its truth, as a folder."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from roel_service.arrays import Array, FloatArray, IntArray
from roel_service.errors import ConfigError, InputError
from roel_service.geometry.se3 import SE3, rotation_from_vector
from roel_service.in_order import in_order
from roel_service.io.camera import write_camera
from roel_service.io.clouds import write_npz
from roel_service.io.events import write_events_hdf5
from roel_service.io.poses import write_trajectory
from roel_service.progress import Progress, ProgressCallback, ignore
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventStream, concatenate
from roel_service.scene.trajectory import Trajectory
from roel_service.simulate.curved import curved_room
from roel_service.simulate.meshes import scene_from_mesh
from roel_service.simulate.motion import (
    Motion,
    as_odometry,
    walk_around,
    walk_in_room,
    with_white_noise,
)
from roel_service.simulate.panoramas import render_panorama
from roel_service.simulate.render import THREAD_COUNT, render, render_depth
from roel_service.simulate.rooms import furnished_room, grid_cube
from roel_service.simulate.scenes import Scene, texture_atlas
from roel_service.simulate.sensor import EventSensor, SensorModel
from roel_service.simulate.truth import edges_along, observable_edges, surface_cloud

SCENES = ("room", "cube", "curved")
# The cube is looked at from this far, as in the paper.
CUBE_DISTANCE = 25.0
# Side of a room, in whose units voxels and noise are given.
ROOM_SIDE_M = 5.0
# No edge moves farther than this between two pictures; thresholds are crossed on a straight line
# in between.
MAX_MOTION_PX = 0.7
MIN_INTERVAL_US, MAX_INTERVAL_US = 200, 5_000
# Speeds are measured this often, on pictures this many times smaller.
SPEED_INTERVAL_US = 20_000
SPEED_REDUCTION = 8
# Share of the pixels that may move faster than what counts as the picture's speed.
FAST_SHARE = 0.02
# Views for the true edges, and places for the cloud.
EDGE_INTERVAL_US = 50_000
CLOUD_PLACE_COUNT = 8
# Every fourth panorama is tilted by at most this.
MAX_TILT_RAD = np.deg2rad(20.0)
# Panoramas are taken within this share of the scene's size around its centre.
PANORAMA_REACH = 0.22
JPEG_QUALITY = 92
# Events are handed on in pieces of at least this many.
PIECE_EVENT_COUNT = 500_000
STAGES = ("events", "edges", "cloud", "panoramas")
# What draws from a stream of chance of its own, in this order, and what of it makes a walk.
PRODUCTS = ("scene", "motion", "odometry", "events", "cloud", "panoramas")
OF_THE_WALK = ("motion", "odometry", "events")


@dataclass(frozen=True, kw_only=True)
class SimulationConfig:
    """What to simulate.

    Attributes:
        seconds: duration.
        width, height: sensor size, px.
        fov_deg: horizontal field of view.
        panorama_count: panoramas beside the events.
        panorama_width: px.
        scene: `room`, a furnished room of chance; `cube`, the paper's cube; or `curved`, a room of
            round things.
        mesh: a textured mesh of the user's; takes the place of the scene.
        sensor: thresholds and noise.
        trajectory_seed: takes the place of the seed for motion, odometry and noise of the sensor:
            another walk through the same scene; None is the walk of the seed itself.

    Raises:
        ConfigError: a value out of range.
    """

    seconds: float = 3.0
    width: int = 346
    height: int = 260
    fov_deg: float = 72.0
    panorama_count: int = 4
    panorama_width: int = 2048
    scene: str = "room"
    mesh: Path | None = None
    sensor: SensorModel = field(default_factory=SensorModel)
    trajectory_seed: int | None = None

    def __post_init__(self) -> None:
        for name, low, high in (
            ("seconds", 0.01, 3600),
            ("width", 16, 4096),
            ("height", 16, 4096),
            ("fov_deg", 1, 170),
            ("panorama_count", 0, 999),
            ("panorama_width", 64, 8192),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise ConfigError(f"simulate.{name}", f"{low} to {high}", f"{value}")
        if self.scene not in SCENES:
            raise ConfigError("simulate.scene", "one of " + ", ".join(SCENES), self.scene)

    @property
    def camera(self) -> Camera:
        """An ideal pinhole camera with the principal point in the middle."""
        focal_px = 0.5 * self.width / np.tan(np.deg2rad(self.fov_deg) / 2)
        return Camera(
            width=self.width,
            height=self.height,
            fx_px=float(focal_px),
            fy_px=float(focal_px),
            cx_px=(self.width - 1) / 2,
            cy_px=(self.height - 1) / 2,
        )


def simulate_dataset(
    folder: Path, config: SimulationConfig, seed: int, progress: ProgressCallback = ignore
) -> int:
    """Write a recording with its truth; equal arguments give equal files.

    The folder is made whole under another name beside it and renamed at the end.

    Args:
        folder: must not exist, or be empty.
        config: what to simulate.
        seed: fixes scene, motion, noise and panoramas.
        progress: may raise `Cancelled`; nothing is left then.

    Returns:
        Number of events.

    Raises:
        InputError: the folder is in use or cannot be made.
        MeshError: the mesh cannot be used.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(str(folder), "a new or empty folder", "one that is in use")
    recording = _Recording(config, seed, progress)
    try:
        temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.absolute().parent))
    except OSError as error:
        raise InputError(str(folder), "a folder that can be made", str(error)) from error
    try:
        event_count = recording.write(temporary)
        temporary.chmod(0o755)
        if folder.exists():
            folder.rmdir()
        temporary.rename(folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return event_count


class _Recording:
    """Scene, motion and chance of one run; each product draws from its own stream of chance."""

    def __init__(self, config: SimulationConfig, seed: int, progress: ProgressCallback) -> None:
        self.config = config
        self.progress = progress
        self.rng = _streams_of_chance(seed)
        if config.trajectory_seed is not None:
            walk = _streams_of_chance(config.trajectory_seed)
            self.rng |= {name: walk[name] for name in OF_THE_WALK}
        self.scene = _scene(config, self.rng["scene"])
        self.scale = float(np.ptp(self.scene.bounds_m, axis=0).max()) / ROOM_SIDE_M
        self.outside = config.mesh is None and config.scene == "cube"
        if self.outside:
            self.motion = walk_around(CUBE_DISTANCE, self.rng["motion"])
        else:
            self.motion = walk_in_room(self.scene.bounds_m, self.rng["motion"])
        self.duration_us = round(config.seconds * 1e6)
        self.grey = texture_atlas(self.scene.textures, grey=True)

    def write(self, folder: Path) -> int:
        camera = self.config.camera
        trajectory = self.motion.trajectory(self.duration_us)
        write_trajectory(folder / "poses.txt", trajectory)
        write_trajectory(folder / "poses_noisy.txt", self._noisy(trajectory))
        write_camera(folder / "camera.json", camera)
        counter = _Counter()
        write_events_hdf5(folder / "events.h5", counter.passing(self._events()))
        self._write_truth(folder, camera)
        self._write_panoramas(folder)
        return counter.count

    def _noisy(self, trajectory: Trajectory) -> Trajectory:
        """Poses as an odometry gives them; of the cube, with the noise of the paper's experiment."""
        rng = self.rng["odometry"]
        if not self.outside:
            return as_odometry(trajectory, self.scale, rng)
        poses = with_white_noise(trajectory.T_world_camera, 1.0, rng)
        return Trajectory(t_us=trajectory.t_us, T_world_camera=poses)

    def _tell(self, stage: str, done_count: int, total_count: int) -> None:
        begins = (0.0, 0.8, 0.9, 0.93, 1.0)
        index = STAGES.index(stage)
        share = done_count / max(1, total_count)
        fraction = begins[index] + share * (begins[index + 1] - begins[index])
        self.progress(
            Progress(stage=stage, done_count=done_count, total_count=total_count, fraction=fraction)
        )

    def _events(self) -> Iterator[EventStream]:
        """Events front to back, in large pieces."""
        times_us = picture_times(self.scene, self.motion, self.config.camera, self.duration_us)
        pictures = in_order(self._grey_picture, times_us.tolist(), THREAD_COUNT)
        sensor = EventSensor(self.config.sensor, next(pictures), self.rng["events"])
        piece: list[EventStream] = []
        for index, (t_us, picture) in enumerate(zip(times_us[1:], pictures, strict=True)):
            piece.append(sensor.advance(picture, int(t_us)))
            self._tell("events", index, len(times_us))
            if sum(len(events) for events in piece) >= PIECE_EVENT_COUNT:
                yield concatenate(piece)
                piece = []
        if piece:
            yield concatenate(piece)

    def _grey_picture(self, t_us: int) -> Array:
        camera = self.config.camera
        T_world_camera = self.motion.poses(np.array([t_us]))[0]
        size = (camera.width, camera.height)
        return render(self.scene, self.grey, T_world_camera, camera.matrix, *size)[..., 0]

    def _write_truth(self, folder: Path, camera: Camera) -> None:
        t_us = np.arange(0, self.duration_us + 1, EDGE_INTERVAL_US)
        T_world_camera = self.motion.poses(t_us)
        edges = observable_edges(
            self.scene,
            self.grey,
            T_world_camera,
            camera.matrix,
            camera.width,
            camera.height,
            self.scale,
            lambda done, total: self._tell("edges", done, total),
        )
        bounds_m = self.scene.bounds_m
        truth = {
            "triangles": self.scene.triangles.astype(np.float32),
            "edges": edges,
            "dims": bounds_m[1] - bounds_m[0],
        }
        if self.scene.rims:
            truth["curved_edges"] = edges_along(self.scene.rims, edges, self.scale)
        write_npz(folder / "gt.npz", **truth)
        self._tell("cloud", 0, 1)
        chance = self.rng["cloud"]
        places = self._places(CLOUD_PLACE_COUNT, chance)
        write_npz(
            folder / "cloud.npz", points=surface_cloud(self.scene, places, self.scale, chance)
        )

    def _places(self, count: int, rng: np.random.Generator) -> FloatArray:
        """(count, 3) m: places from which the scene can be seen."""
        if self.outside:
            t_us = rng.integers(0, self.duration_us, size=count, endpoint=True)
            return self.motion.poses(np.sort(t_us)).translation
        bounds_m = self.scene.bounds_m
        reach_m = PANORAMA_REACH * (bounds_m[1] - bounds_m[0])
        middle = np.append(bounds_m[:, :2].mean(axis=0), self.motion.centre[2])
        return np.asarray(middle + rng.uniform(-1, 1, size=(count, 3)) * reach_m)

    def _write_panoramas(self, folder: Path) -> None:
        (folder / "panos").mkdir()
        atlas = texture_atlas(self.scene.textures, grey=False)
        width = self.config.panorama_width

        def picture(pose: SE3) -> Array:
            return render_panorama(self.scene, atlas, pose, width)

        poses = self._panorama_poses()
        lines = ["# index tx ty tz qx qy qz qw  (T_world_panorama)"]
        pictures = in_order(picture, poses, THREAD_COUNT)
        for index, (pose, panorama) in enumerate(zip(poses, pictures, strict=True)):
            self._tell("panoramas", index, len(poses))
            _write_jpeg(folder / "panos" / f"{index:03d}.jpg", panorama)
            numbers = [*pose.translation, *pose.quaternion_xyzw()]
            lines.append(" ".join([str(index), *(f"{number:.9f}" for number in numbers)]))
        (folder / "panos" / "poses.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")

    def _panorama_poses(self) -> list[SE3]:
        """`T_world_panorama` of each panorama: any heading, every fourth one tilted."""
        rng = self.rng["panoramas"]
        poses = []
        for index, place in enumerate(self._places(self.config.panorama_count, rng)):
            tilt_rad = rng.uniform(-1, 1, size=2) * MAX_TILT_RAD / np.sqrt(2)
            turn = rotation_from_vector(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
            if index % 4 == 3:
                turn = turn @ rotation_from_vector(np.append(tilt_rad, 0.0))
            poses.append(SE3(rotation=turn, translation=place))
        return poses


def _streams_of_chance(seed: int) -> dict[str, np.random.Generator]:
    children = np.random.SeedSequence(seed).spawn(len(PRODUCTS))
    return dict(zip(PRODUCTS, map(np.random.default_rng, children), strict=True))


class _Counter:
    """Counts the events that pass."""

    count = 0

    def passing(self, pieces: Iterator[EventStream]) -> Iterator[EventStream]:
        for piece in pieces:
            self.count += len(piece)
            yield piece


def _scene(config: SimulationConfig, rng: np.random.Generator) -> Scene:
    if config.mesh is not None:
        return scene_from_mesh(config.mesh)
    if config.scene == "cube":
        return grid_cube()
    return furnished_room(rng) if config.scene == "room" else curved_room(rng)


def picture_times(scene: Scene, motion: Motion, camera: Camera, duration_us: int) -> IntArray:
    """(n,) times from 0 to the end at which the sensor looks; closer where the picture moves fast."""
    small = np.diag([1 / SPEED_REDUCTION, 1 / SPEED_REDUCTION, 1.0])
    K = small @ camera.matrix
    width, height = camera.width // SPEED_REDUCTION, camera.height // SPEED_REDUCTION
    times = [0]
    while times[-1] < duration_us:
        begin_us = times[-1]
        end_us = min(begin_us + SPEED_INTERVAL_US, duration_us)
        speed = SPEED_REDUCTION * _speed_px_per_us(scene, motion, K, width, height, begin_us)
        interval_us = np.clip(MAX_MOTION_PX / max(speed, 1e-12), MIN_INTERVAL_US, MAX_INTERVAL_US)
        count = int(np.ceil((end_us - begin_us) / interval_us))
        times += np.linspace(begin_us, end_us, count + 1).round().astype(int).tolist()[1:]
    return np.array(times, dtype=np.int64)


def _speed_px_per_us(
    scene: Scene, motion: Motion, K: FloatArray, width: int, height: int, t_us: int
) -> float:
    """Speed that only `FAST_SHARE` of the pixels exceed, from their depth and two poses."""
    poses = motion.poses(np.array([t_us, t_us + MIN_INTERVAL_US]))
    depth_m = render_depth(scene, poses[0], K, width, height)
    rows, columns = np.nonzero(np.isfinite(depth_m))
    if len(rows) == 0:
        return 0.0
    pixel = np.stack([columns, rows, np.ones(len(rows))], axis=-1).astype(np.float64)
    in_camera = (pixel @ np.linalg.inv(K).T) * depth_m[rows, columns, None]
    in_world = poses[0] @ np.asarray(in_camera)
    moved = (poses[1].inverse() @ in_world) @ K.T
    step = np.linalg.norm(moved[:, :2] / moved[:, 2:] - pixel[:, :2], axis=1)
    return float(np.quantile(step, 1 - FAST_SHARE)) / MIN_INTERVAL_US


def _write_jpeg(path: Path, picture: Array) -> None:
    """Linear RGB as a JPEG with gamma."""
    bytes_rgb = np.rint(255.0 * picture.clip(0, 1) ** (1 / 2.2)).astype(np.uint8)
    done, data = cv2.imencode(
        ".jpg", np.ascontiguousarray(bytes_rgb[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    )
    if not done:
        raise InputError(str(path), "a picture that JPEG can hold", f"{picture.shape}")
    path.write_bytes(data.tobytes())
