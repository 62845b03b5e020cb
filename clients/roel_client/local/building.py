"""A recording becomes a map, here or on a server."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from roel_client.local.recordings import Recording
from roel_service.naming import naming

if TYPE_CHECKING:
    from roel_service.config.stages import Config
    from roel_service.progress import ProgressCallback
    from roel_service.scene.trajectory import Trajectory


@dataclass(frozen=True, eq=False, kw_only=True)
class Built:
    """A finished map as a file's bytes, and the report of its build.

    Attributes:
        trajectory: the poses of the map; None where they are those that were given.
    """

    rlm_bytes: bytes
    report: dict[str, Any]
    trajectory: Trajectory | None = None


def build_map(recording: Recording, config: Config, progress: ProgressCallback) -> Built:
    """Build a map in this process.

    Raises:
        NoAnswerError: fewer lines than a map needs.
        RoelError: whatever reading and building raise.
    """
    from roel_service.jobs import build

    with naming(recording.names):
        built = build.build_map(
            recording.events, recording.trajectory, recording.camera, config, progress
        )
    return Built(rlm_bytes=built.rlm_bytes, report=built.report, trajectory=built.trajectory)


def build_map_remotely(
    recording: Recording,
    config: Config,
    progress: ProgressCallback,
    server: str,
    options: dict[str, Any],
) -> Built:
    """Let a server build the map; raises as `build_map`, and `UnavailableError`.

    Args:
        server: `HOST:PORT`.
        options: arguments of `Client` beside the address.
    """
    from roel_client.client import Client

    with naming(recording.names), Client(server, **options) as client:
        rlm_bytes, report, trajectory = client.map_recording_with_poses(
            recording.events, recording.trajectory, recording.camera, config, progress
        )
    return Built(rlm_bytes=rlm_bytes, report=report, trajectory=trajectory)


def draw_map(built: Built, recording: Recording, path: Path) -> None:
    """Write the picture of a map."""
    from roel_service.evaluation import figures
    from roel_service.wire.rlm import decode_map

    line_map = decode_map(built.rlm_bytes).line_map
    trajectory = built.trajectory or recording.trajectory
    figures.draw_map(line_map, trajectory, recording.camera, recording.events, path)
