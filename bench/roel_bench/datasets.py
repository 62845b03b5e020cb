"""Folders of public data sets, opened as their publishers lay them out.

| set | documented by |
| --- | --- |
| TUM-VIE | cvg.cit.tum.de/data/datasets/visual-inertial-event-dataset; calibrations as Basalt saves them |
| VECtor | star-datasets.github.io/vector and its toolboxes mgaoling/mpl_{dataset,calibration}_toolbox |
| Replica | the scenes and trajectories of iMAP as NICE-SLAM distributes them, and events made from them |

The paper runs the first two with poses of DEVO; pass them as `poses`. Nothing of the sets is part
of this project.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from roel_bench.scenes import MapTruth, Scene
from roel_service.arrays import FloatArray
from roel_service.errors import CameraError, TrajectoryError
from roel_service.geometry.projection import CameraModel
from roel_service.geometry.se3 import SE3
from roel_service.io.camera import read_camera
from roel_service.io.clouds import read_mesh
from roel_service.io.events import open_events
from roel_service.io.files import read_input
from roel_service.io.poses import read_trajectory
from roel_service.io.text import parse_rows, us_from_seconds
from roel_service.scene.camera import Camera
from roel_service.scene.trajectory import Trajectory

# Sequences of TUM-VIE that were recorded with calibration A; all others have calibration B.
TUM_VIE_WITH_CALIBRATION_A = (
    *("loop-floor0", "loop-floor1", "loop-floor2", "loop-floor3"),
    *("mocap-desk", "mocap-desk2", "skate-easy"),
)
# Cameras 0 and 1 of TUM-VIE and VECtor take pictures; 2 and 3 are event cameras, left and right.
LEFT_EVENT_CAMERA = 2
# iMAP's 2000 poses fill the paper's 20 s.
REPLICA_RATE_HZ = 100.0
# Calibrations are small, and so are trajectories: an hour of 200 Hz has 80 MB of text.
MAX_CALIBRATION_BYTES = 1 << 20
MAX_POSES_BYTES = 1 << 27
# Printed with 6 digits, a rotation is orthonormal to a few times 1e-6.
MAX_ROTATION_ERROR = 1e-3


def open_tum_vie(folder: Path, sequence: str, *, poses: Path | None = None) -> Scene:
    """The left event camera of a TUM-VIE sequence.

    The folder holds what the publisher offers for download, archives unpacked:
    `SEQUENCE-events_left.h5`, `SEQUENCE-vi_gt_data/mocap_data.txt`, `camera-calibrationA.json` and
    `mocap-imu-calibrationA.json` (or B). Events and motion capture share one clock, in us.
    T_world_camera = T_world_marker T_imu_marker^-1 T_imu_camera; the world is that of the motion
    capture.

    Args:
        folder: of the files.
        sequence: such as `mocap-desk2`.
        poses: TUM text with poses of the left event camera that take the place of motion capture.

    Raises:
        InputError: a file is missing, or not what the publisher describes.
    """
    letter = "A" if sequence in TUM_VIE_WITH_CALIBRATION_A else "B"
    calibration_file = folder / f"camera-calibration{letter}.json"
    calibration = _json(calibration_file)
    camera = _basalt_camera(calibration, LEFT_EVENT_CAMERA, str(calibration_file))
    if poses is None:
        marker_file = folder / f"mocap-imu-calibration{letter}.json"
        T_imu_marker = _basalt_transform(_json(marker_file), str(marker_file), "T_imu_marker")
        T_imu_camera = _basalt_transform(
            calibration, str(calibration_file), "T_imu_cam", LEFT_EVENT_CAMERA
        )
        trajectory = _moved(
            _mocap_trajectory(folder / f"{sequence}-vi_gt_data" / "mocap_data.txt"),
            T_imu_marker.inverse() @ T_imu_camera,
        )
    else:
        trajectory = read_trajectory(poses)
    events_file = folder / f"{sequence}-events_left.h5"
    return Scene(
        name=f"tum_vie_{sequence}",
        events=open_events(events_file, camera.width, camera.height),
        camera=camera,
        trajectory=trajectory,
    )


def open_vector(folder: Path, sequence: str, *, poses: Path | None = None) -> Scene:
    """The left event camera of a small-scale VECtor sequence.

    The folder holds what the publisher offers for download: `SEQUENCE.synced.left_event.hdf5`,
    `SEQUENCE.synced.gt.txt` (TUM text, poses of the rig's markers), and the calibrations
    `left_event_camera_intrinsic_results.yaml`, `camera_mocap_extrinsic_results1.yaml` (`cam0`,
    `T_cam_body`) and `small_scale_joint_camera_extrinsic_results.yaml` (`cam2`, `T_cam0_cam2`).
    T_world_camera = T_world_body T_cam0_body^-1 T_cam0_cam2.

    Args:
        folder: of the files.
        sequence: such as `desk_normal1`.
        poses: TUM text with poses of the left event camera that take the place of motion capture.

    Raises:
        InputError: a file is missing, or not what the publisher describes.
    """
    camera = read_camera(folder / "left_event_camera_intrinsic_results.yaml")
    if poses is None:
        body_file = folder / "camera_mocap_extrinsic_results1.yaml"
        joint_file = folder / "small_scale_joint_camera_extrinsic_results.yaml"
        T_cam0_body = _matrix_transform(body_file, "cam0", "T_cam_body")
        T_cam0_camera = _matrix_transform(
            joint_file, f"cam{LEFT_EVENT_CAMERA}", f"T_cam0_cam{LEFT_EVENT_CAMERA}"
        )
        trajectory = _moved(
            read_trajectory(folder / f"{sequence}.synced.gt.txt"),
            T_cam0_body.inverse() @ T_cam0_camera,
        )
    else:
        trajectory = read_trajectory(poses)
    events_file = folder / f"{sequence}.synced.left_event.hdf5"
    return Scene(
        name=f"vector_{sequence}",
        events=open_events(events_file, camera.width, camera.height),
        camera=camera,
        trajectory=trajectory,
    )


def open_replica(
    folder: Path, scene: str, *, events: Path | None = None, rate_hz: float = REPLICA_RATE_HZ
) -> Scene:
    """A Replica scene with the trajectory of iMAP and simulated events.

    The folder is NICE-SLAM's: `cam_params.json`, `SCENE_mesh.ply`, and `SCENE/traj.txt` with a
    T_world_camera of 16 numbers a line, row by row, camera axes as here. No times belong to them:
    line i is taken at i / `rate_hz`. Whoever renders along other poses puts them into
    `SCENE/poses.txt` (TUM text), which then takes the place of `traj.txt`.

    Args:
        folder: of the whole set.
        scene: such as `office4`.
        events: simulated from the scene (the paper: VID2E), in a format that the service reads;
            `SCENE/events.h5` by default.
        rate_hz: lines of `traj.txt` a second; the default gives the paper's 20 s.

    Raises:
        InputError: a file is missing, or not what the publisher describes.
    """
    camera = _replica_camera(folder / "cam_params.json")
    timed = folder / scene / "poses.txt"
    if timed.exists():
        trajectory = read_trajectory(timed)
    else:
        trajectory = _matrix_trajectory(folder / scene / "traj.txt", rate_hz)
    return Scene(
        name=f"replica_{scene}",
        events=open_events(events or folder / scene / "events.h5", camera.width, camera.height),
        camera=camera,
        trajectory=trajectory,
        truth=MapTruth(mesh=read_mesh(folder / f"{scene}_mesh.ply"), edges=None),
    )


def _moved(trajectory: Trajectory, T_body_camera: SE3) -> Trajectory:
    """Poses of a camera that is fixed to the body whose poses are known."""
    return Trajectory(
        t_us=trajectory.t_us, T_world_camera=trajectory.T_world_camera @ T_body_camera
    )


def _mocap_trajectory(path: Path) -> Trajectory:
    """Lines `t px py pz qx qy qz qw`; the publisher's times are us, some converters' seconds."""
    rows = _rows(path, "t px py pz qx qy qz qw")
    # Poses come every 8 ms: 8333 us, or 0.008 s.
    is_us = len(rows) > 1 and np.median(np.diff(rows[:, 0])) >= 1.0
    t_us = np.rint(rows[:, 0]).astype(np.int64) if is_us else us_from_seconds(rows[:, 0])
    _check_unit_quaternions(rows[:, 4:], str(path))
    return Trajectory(t_us=t_us, T_world_camera=SE3.from_quaternion(rows[:, 4:], rows[:, 1:4]))


def _check_unit_quaternions(quaternions: FloatArray, subject: str) -> None:
    norms = np.linalg.norm(quaternions, axis=-1)
    if (np.abs(norms - 1.0) > MAX_ROTATION_ERROR).any():
        worst = norms[np.argmax(np.abs(norms - 1.0))]
        raise TrajectoryError(subject, "quaternions of norm 1", f"{worst:.6g}")


def _matrix_trajectory(path: Path, rate_hz: float) -> Trajectory:
    if not rate_hz > 0:
        raise TrajectoryError("rate_hz", "> 0", f"{rate_hz}")
    rows = _rows(path, " ".join(f"m{i}{j}" for i in range(4) for j in range(4)))
    t_us = us_from_seconds(np.arange(len(rows)) / rate_hz)
    T_world_camera = _rigid(rows.reshape(-1, 4, 4), str(path))
    return Trajectory(t_us=t_us, T_world_camera=T_world_camera)


def _rows(path: Path, columns: str) -> FloatArray:
    text = read_input(path, MAX_POSES_BYTES)
    return parse_rows(text, columns, 1, str(path), TrajectoryError)


def _rigid(matrices: FloatArray, subject: str) -> SE3:
    """Transforms of (*B, 4, 4) matrices; the digits that rotations lost in print are restored."""
    rotation = matrices[..., :3, :3]
    u, stretch, vt = np.linalg.svd(rotation)
    is_rigid = (np.abs(stretch - 1.0) < MAX_ROTATION_ERROR).all() and (
        np.linalg.det(rotation) > 0
    ).all()
    if not is_rigid or not np.allclose(matrices[..., 3, :], [0.0, 0.0, 0.0, 1.0]):
        raise TrajectoryError(subject, "4x4 matrices of rigid transforms", "another matrix")
    return SE3(rotation=u @ vt, translation=matrices[..., :3, 3])


def _basalt_camera(document: Any, index: int, subject: str) -> Camera:
    """Camera `index` of a calibration of Basalt, with the four coefficients of `kb4`."""
    model = _lookup(document, subject, "value0", "intrinsics", index, "camera_type")
    if model != "kb4":
        raise CameraError(subject, f"camera {index} of type kb4", repr(model))

    def value(name: str) -> float:
        return _number(document, subject, "value0", "intrinsics", index, "intrinsics", name)

    width, height = (
        int(_number(document, subject, "value0", "resolution", index, axis)) for axis in (0, 1)
    )
    return Camera(
        width=width,
        height=height,
        fx_px=value("fx"),
        fy_px=value("fy"),
        cx_px=value("cx"),
        cy_px=value("cy"),
        model=CameraModel.FISHEYE,
        distortion=tuple(value(name) for name in ("k1", "k2", "k3", "k4")),
    )


def _basalt_transform(document: Any, subject: str, *keys: str | int) -> SE3:
    position, quaternion = (
        np.array([_number(document, subject, "value0", *keys, name) for name in names])
        for names in (("px", "py", "pz"), ("qx", "qy", "qz", "qw"))
    )
    _check_unit_quaternions(quaternion, subject)
    return SE3.from_quaternion(quaternion, position)


def _matrix_transform(path: Path, camera: str, name: str) -> SE3:
    """A transform of a YAML file: 16 numbers, row by row."""
    subject = str(path)
    try:
        document = yaml.safe_load(read_input(path, MAX_CALIBRATION_BYTES))
    except yaml.YAMLError as error:
        raise CameraError(subject, "YAML", str(error).splitlines()[0]) from error
    values = [_number(document, subject, camera, name, index) for index in range(16)]
    return _rigid(np.array(values).reshape(4, 4), subject)


def _replica_camera(path: Path) -> Camera:
    document = _json(path)

    def value(name: str) -> float:
        return _number(document, str(path), "camera", name)

    return Camera(
        width=int(value("w")),
        height=int(value("h")),
        fx_px=value("fx"),
        fy_px=value("fy"),
        cx_px=value("cx"),
        cy_px=value("cy"),
    )


def _json(path: Path) -> Any:
    try:
        return json.loads(read_input(path, MAX_CALIBRATION_BYTES))
    except ValueError as error:
        raise CameraError(str(path), "JSON", str(error)) from error


def _number(document: Any, subject: str, *keys: str | int) -> float:
    value = _lookup(document, subject, *keys)
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise CameraError(subject, f"a number {_path(keys)}", repr(value)[:80])
    return float(value)


def _lookup(document: Any, subject: str, *keys: str | int) -> Any:
    """The value below a path of keys and list indices."""
    value = document
    for key in keys:
        is_there = (isinstance(value, dict) and key in value) or (
            isinstance(value, list) and isinstance(key, int) and key < len(value)
        )
        if not is_there:
            raise CameraError(subject, f"a value {_path(keys)}", "none")
        value = value[key]
    return value


def _path(keys: tuple[str | int, ...]) -> str:
    return ".".join(str(key) for key in keys)
