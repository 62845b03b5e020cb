"""The commands' work in this process: the only module of the client that loads algorithms.

Each function imports what it needs when it is called, so that importing this module costs nothing.
Files are named as the user gave them, because errors repeat the name.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from roel_service.io.events import EventFile
    from roel_service.scene.camera import Camera
    from roel_service.scene.lines import LineMap
    from roel_service.scene.trajectory import Trajectory

_RLM_MAGIC = b"RLM1"


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording:
    """An opened recording; events are read when somebody asks for them."""

    events: EventFile
    trajectory: Trajectory
    camera: Camera


@dataclass(frozen=True, eq=False, kw_only=True)
class Built:
    """A finished map: as a file's bytes and as lines, with the report of its build."""

    rlm_bytes: bytes
    line_map: LineMap
    report: dict[str, Any]


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
    return Recording(events=source, trajectory=trajectory, camera=calibration)


def draw_map(line_map: LineMap, recording: Recording, path: Path) -> None:
    """Write the picture of a map."""
    from roel_service.evaluation import figures

    figures.draw_map(line_map, recording.trajectory, recording.camera, recording.events, path)
