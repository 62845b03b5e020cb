"""Cameras, poses and boxes as messages; `foo_to_proto` beside `foo_from_proto`."""

from __future__ import annotations

import numpy as np

from roel_service.arrays import Array, BoolArray, FloatArray
from roel_service.errors import CameraError, InputError, TrajectoryError
from roel_service.geometry.se3 import SE3
from roel_service.scene.camera import Camera, CameraModel
from roel_service.scene.trajectory import Trajectory
from roel_service.v1 import types_pb2

# Largest entry of R^T R - I; float64 rotations from any library are many orders below.
ROTATION_TOLERANCE = 1e-6

_MODELS = {
    CameraModel.PINHOLE: types_pb2.CAMERA_MODEL_PINHOLE,
    CameraModel.FISHEYE: types_pb2.CAMERA_MODEL_FISHEYE,
}


def camera_to_proto(camera: Camera) -> types_pb2.Camera:
    """All bits of the calibration."""
    return types_pb2.Camera(
        width=camera.width,
        height=camera.height,
        fx_px=camera.fx_px,
        fy_px=camera.fy_px,
        cx_px=camera.cx_px,
        cy_px=camera.cy_px,
        model=_MODELS[camera.model],
        distortion=camera.distortion,
    )


def camera_from_proto(message: types_pb2.Camera) -> Camera:
    """Raises `CameraError` for a calibration that cannot be."""
    models = {number: model for model, number in _MODELS.items()}
    if message.model not in models:
        raise CameraError("camera", "model PINHOLE or FISHEYE", f"{message.model}")
    return Camera(
        width=message.width,
        height=message.height,
        fx_px=message.fx_px,
        fy_px=message.fy_px,
        cx_px=message.cx_px,
        cy_px=message.cy_px,
        model=models[message.model],
        distortion=tuple(message.distortion),
    )


def trajectory_to_proto(trajectory: Trajectory) -> types_pb2.Trajectory:
    """All bits of every pose: the same trajectory comes back."""
    return types_pb2.Trajectory(
        t_us=_bytes(trajectory.t_us, "<i8"),
        translation_m=_bytes(trajectory.T_world_camera.translation, "<f8"),
        rotation=_bytes(trajectory.T_world_camera.rotation, "<f8"),
    )


def trajectory_from_proto(*parts: types_pb2.Trajectory) -> Trajectory:
    """One trajectory from its parts in the order of time.

    Raises:
        TrajectoryError: columns of unequal length, values that are not finite, rotations that are
            none, fewer than two poses, times that do not increase.
    """
    columns = [trajectory_columns(part) for part in parts]
    t_us, translation, rotation = (np.concatenate(column) for column in zip(*columns, strict=True))
    return Trajectory(t_us=t_us, T_world_camera=SE3(rotation=rotation, translation=translation))


def trajectory_columns(message: types_pb2.Trajectory) -> tuple[Array, FloatArray, FloatArray]:
    """Checked columns of one part: times (N,) us, positions (N, 3) m, rotations (N, 3, 3)."""
    t_us = _column(message.t_us, "<i8", (), "t_us")
    translation = _column(message.translation_m, "<f8", (3,), "translation_m")
    rotation = _column(message.rotation, "<f8", (3, 3), "rotation")
    if not len(t_us) == len(translation) == len(rotation):
        found = f"{len(t_us)}, {len(translation)} and {len(rotation)}"
        raise TrajectoryError("poses", "as many times as positions and rotations", found)
    _check_finite(translation, "position")
    _check_rotations(rotation)
    return t_us, translation, rotation


def bounds_to_proto(lower_m: FloatArray, upper_m: FloatArray) -> types_pb2.Bounds:
    """From the two corners, (3,) each."""
    return types_pb2.Bounds(
        min_x_m=lower_m[0],
        min_y_m=lower_m[1],
        min_z_m=lower_m[2],
        max_x_m=upper_m[0],
        max_y_m=upper_m[1],
        max_z_m=upper_m[2],
    )


def bounds_from_proto(message: types_pb2.Bounds) -> tuple[FloatArray, FloatArray]:
    """The two corners, (3,) m each."""
    lower_m = np.array([message.min_x_m, message.min_y_m, message.min_z_m])
    upper_m = np.array([message.max_x_m, message.max_y_m, message.max_z_m])
    return lower_m, upper_m


def transform_to_proto(T_target_source: SE3, target: str, source: str) -> types_pb2.Transform:
    """One transform between two frames, all bits of it."""
    return types_pb2.Transform(
        target_frame=target,
        source_frame=source,
        translation_m=vector_to_proto(T_target_source.translation),
        rotation=T_target_source.rotation.ravel().tolist(),
    )


def transform_from_proto(message: types_pb2.Transform, subject: str) -> SE3:
    """One transform; its frames are for people.

    Raises:
        InputError: no rotation within `ROTATION_TOLERANCE`, or a translation that is not finite.
    """
    translation = vector_from_proto(message.translation_m)
    if len(message.rotation) != 9 or not np.isfinite(translation).all():
        found = f"{len(message.rotation)} numbers and {translation.tolist()}"
        raise InputError(subject, "9 numbers of a rotation and a finite translation", found)
    rotation = np.array(message.rotation).reshape(3, 3)
    if not _is_rotation(rotation):
        raise InputError(subject, "a rotation matrix", f"{rotation.tolist()}")
    return SE3(rotation=rotation, translation=translation)


def vector_to_proto(vector: FloatArray) -> types_pb2.Vector3:
    """From (3,)."""
    return types_pb2.Vector3(x=vector[0], y=vector[1], z=vector[2])


def vector_from_proto(message: types_pb2.Vector3) -> FloatArray:
    """(3,), finite or not."""
    return np.array([message.x, message.y, message.z])


def matrix6_to_proto(matrix: FloatArray) -> types_pb2.Matrix6:
    """From (6, 6)."""
    return types_pb2.Matrix6(values=matrix.ravel().tolist())


def matrix6_from_proto(message: types_pb2.Matrix6) -> FloatArray:
    """(6, 6)."""
    return np.array(message.values).reshape(6, 6)


def _bytes(values: Array, dtype: str) -> bytes:
    return np.ascontiguousarray(values, dtype=dtype).tobytes()


def _column(data: bytes, dtype: str, row_shape: tuple[int, ...], name: str) -> Array:
    row_bytes = np.dtype(dtype).itemsize * int(np.prod(row_shape, dtype=int))
    if len(data) % row_bytes:
        found = f"{len(data)} bytes"
        raise TrajectoryError("poses", f"{name} in rows of {row_bytes} bytes", found)
    return np.frombuffer(data, dtype=dtype).reshape(-1, *row_shape)


def _check_finite(translation: FloatArray, name: str) -> None:
    finite = np.isfinite(translation).all(axis=1)
    if not finite.all():
        index = int(np.argmin(finite))
        raise TrajectoryError("poses", f"a finite {name}", f"{translation[index]} at pose {index}")


def _check_rotations(rotation: FloatArray) -> None:
    proper = _is_rotation(rotation)
    if not proper.all():
        index = int(np.argmin(proper))
        raise TrajectoryError("poses", "rotation matrices", f"none at pose {index}")


def _is_rotation(rotation: FloatArray) -> BoolArray:
    """(*B,) which of (*B, 3, 3) are rotations."""
    # NaN compares as False, so the accepting comparison refuses it. Rows far off overflow quietly.
    with np.errstate(over="ignore", invalid="ignore"):
        deviation = np.abs(np.swapaxes(rotation, -1, -2) @ rotation - np.eye(3)).max(axis=(-2, -1))
        return np.asarray((deviation <= ROTATION_TOLERANCE) & (np.linalg.det(rotation) > 0))
