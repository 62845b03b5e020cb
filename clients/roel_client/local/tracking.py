"""The camera of a recording is followed in a map."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from roel_client.local.maps import read_map
from roel_client.local.recordings import write_poses
from roel_service.naming import naming

if TYPE_CHECKING:
    from roel_service.config.stages import Config
    from roel_service.geometry.se3 import SE3


class TrackedRecording:
    """The camera of a recording, followed in a map.

    Args:
        map_name, events, camera, init: files; `init` holds the first T_world_camera.
        sensor_size: for a calibration that does not say it.
        config: parameters.

    Raises:
        InputError: the first file that cannot be used.
        NoAnswerError: TOO_FEW_LINES in the map.
    """

    def __init__(
        self,
        map_name: str,
        events: str,
        camera: str,
        sensor_size: tuple[int, int] | None,
        init: str,
        config: Config,
    ) -> None:
        from roel_service.io.camera import read_camera
        from roel_service.io.events import open_events
        from roel_service.io.transforms import read_transform
        from roel_service.tracking.tracker import PoseTracker

        calibration = read_camera(Path(camera), sensor_size)
        guess = read_transform(Path(init))
        self._names = {"events": events, "map": map_name}
        self._events = open_events(Path(events), calibration.width, calibration.height)
        line_map = read_map(map_name)
        with naming(self._names):
            self._tracker = PoseTracker(
                line_map, calibration, config.track, guess, config.runtime.seed, is_live=False
            )
        self._relied_on: list[tuple[int, SE3]] = []

    def documents(self) -> Iterator[dict[str, Any]]:
        """What `roel track` prints, pose by pose."""
        from roel_service.scene.results import PoseStatus

        with naming(self._names):
            for chunk in self._events.chunks():
                for pose in self._tracker.push(chunk):
                    T, covariance = pose.T_world_camera, pose.covariance
                    if T is not None and pose.status is PoseStatus.TRACKING:
                        self._relied_on.append((pose.t_us, T))
                    yield {
                        "t_us": pose.t_us,
                        "status": pose.status.value,
                        "T_world_camera": None if T is None else T.matrix().tolist(),
                        "covariance": None if covariance is None else covariance.tolist(),
                        "seen_share": pose.seen_share,
                        "sharpness": pose.sharpness,
                        "event_count": pose.event_count,
                    }

    def write(self, out: Path) -> None:
        """Write the poses that may be relied on, at least two, as TUM text."""
        import numpy as np

        from roel_service.geometry.se3 import SE3
        from roel_service.scene.trajectory import Trajectory

        times_us = np.array([t_us for t_us, _ in self._relied_on])
        poses = SE3.from_matrix(np.stack([pose.matrix() for _, pose in self._relied_on]))
        write_poses(Trajectory(t_us=times_us, T_world_camera=poses), out)
