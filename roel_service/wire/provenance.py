"""What a map was made of, as digests of canonical bytes.

The digests depend on values alone, so that a build in this process and one on a server agree, in
whatever format or chunks the inputs came.
"""

from __future__ import annotations

import hashlib
import struct
from dataclasses import dataclass

import numpy as np

from roel_service import __version__
from roel_service.arrays import Array
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventStream
from roel_service.scene.trajectory import Trajectory


@dataclass(frozen=True, kw_only=True)
class Provenance:
    """What a map was made of; empty where it is not known.

    Attributes:
        config_digest: digest of every effective parameter.
        code_version: version of this project that made the map.
        events_sha256, poses_sha256, camera_sha256: lower-case hexadecimal.
    """

    config_digest: str = ""
    code_version: str = __version__
    events_sha256: str = ""
    poses_sha256: str = ""
    camera_sha256: str = ""


class EventDigest:
    """SHA-256 of a recording, taken while its chunks pass by.

    Each column has a hash of its own, so that the result does not depend on the chunks.
    """

    def __init__(self) -> None:
        self._columns = {name: hashlib.sha256() for name in ("t_us", "x", "y", "polarity")}

    def update(self, chunk: EventStream) -> None:
        """Add the next events."""
        for name, dtype in (("t_us", "<i8"), ("x", "<u2"), ("y", "<u2"), ("polarity", "i1")):
            self._columns[name].update(_column_bytes(getattr(chunk, name), dtype))

    def hexdigest(self) -> str:
        """Lower-case hexadecimal digest of the events so far."""
        return hashlib.sha256(b"".join(c.digest() for c in self._columns.values())).hexdigest()


def poses_digest(trajectory: Trajectory) -> str:
    """Lower-case hexadecimal SHA-256 of the times, positions and rotations."""
    poses = trajectory.T_world_camera
    digest = hashlib.sha256(_column_bytes(trajectory.t_us, "<i8"))
    digest.update(_column_bytes(poses.translation, "<f8"))
    digest.update(_column_bytes(poses.rotation, "<f8"))
    return digest.hexdigest()


def camera_digest(camera: Camera) -> str:
    """Lower-case hexadecimal SHA-256 of the calibration."""
    numbers = (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, *camera.distortion)
    data = struct.pack(f"<II{len(numbers)}d", camera.width, camera.height, *numbers)
    return hashlib.sha256(data + camera.model.value.encode()).hexdigest()


def _column_bytes(values: Array, dtype: str) -> memoryview:
    return np.ascontiguousarray(values, dtype).data
