"""Recordings and what is written about them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from roel_service.io.events import EventFile
    from roel_service.scene.camera import Camera
    from roel_service.scene.trajectory import Trajectory


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording:
    """An opened recording; events are read when somebody asks for them.

    Attributes:
        names: what the user called the files, by what errors call them.
    """

    events: EventFile
    trajectory: Trajectory
    camera: Camera
    names: dict[str, str]


def open_recording(
    events: str, poses: str, camera: str, sensor_size: tuple[int, int] | None
) -> Recording:
    """Open the three files of a recording; raises `InputError` for the first that is unusable."""
    from roel_service.io.camera import read_camera
    from roel_service.io.events import open_events
    from roel_service.io.poses import read_trajectory

    calibration = read_camera(Path(camera), sensor_size)
    trajectory = read_trajectory(Path(poses))
    source = open_events(Path(events), calibration.width, calibration.height)
    names = {"events": events, "poses": poses, "camera": camera}
    return Recording(events=source, trajectory=trajectory, camera=calibration, names=names)


def write_poses(trajectory: Trajectory, path: Path) -> None:
    """Write poses as TUM text."""
    from roel_service.io.poses import write_trajectory

    write_trajectory(path, trajectory)
