"""A client that uploads, builds and forgets for ever, whatever happens to the server."""

from __future__ import annotations

import tempfile
import threading
import uuid
from pathlib import Path

import numpy as np

from roel_client import Client
from roel_client.client import Operation
from roel_crash.ledger import Ledger, end_of
from roel_service.config.presets import preset
from roel_service.errors import NotFoundError, RoelError, StateError, UnavailableError
from roel_service.geometry.se3 import SE3, rotation_from_vector
from roel_service.progress import Progress
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventStream
from roel_service.scene.trajectory import Trajectory

CAMERA = Camera(width=64, height=48, fx_px=50.0, fy_px=50.0, cx_px=32.0, cy_px=24.0)

# Three chunks: enough for an upload to be cut in its middle.
EVENT_COUNT = 300_000
# Three parts.
BLOB_BYTES = 3 * 2**20
FOLLOWED_SHARE = 0.5
FORGOTTEN_SHARE = 0.5


class Checker(threading.Thread):
    """One client with a recording and a build at a time."""

    def __init__(self, address: str, ledger: Ledger, seed: int) -> None:
        super().__init__(daemon=True)
        self._address = address
        self._ledger = ledger
        self._rng = np.random.default_rng(seed)
        self._ended = threading.Event()

    def end(self) -> None:
        """Begin nothing more, and wait for what was begun."""
        self._ended.set()
        self.join()

    def run(self) -> None:
        with Client(self._address, timeout_s=60.0) as client:
            while not self._ended.is_set():
                try:
                    self._work(client)
                except UnavailableError:
                    # The server was away for longer than the client is patient.
                    self._ended.wait(0.2)

    def _work(self, client: Client) -> None:
        """A blob, a recording and a build, which follows every second upload."""
        self._upload_blob(client)
        follow = self._rng.random() < FOLLOWED_SHARE
        stream = client.create_event_stream(_new_id(), CAMERA)
        client.upload_poses(stream, self._trajectory())
        map_name = client.create_map(_new_id())
        config = preset("default")
        operation = client.build_map(map_name, stream, config, follow=True) if follow else None
        client.upload_events(stream, self._events(), lambda told: self._note(stream, told))
        self._ledger.note_frozen(client.finalize(stream))
        self._await(operation or client.build_map(map_name, stream, config))
        if self._rng.random() < FORGOTTEN_SHARE:
            # What it held is garbage then, for sweeps to find.
            self._ledger.forget(stream)
            client.delete_event_stream(stream)

    def _upload_blob(self, client: Client) -> None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "blob")
            path.write_bytes(self._rng.bytes(BLOB_BYTES))
            self._ledger.note_blob(client.upload_blob(path))

    def _await(self, operation: Operation) -> None:
        """Write down how a build ends."""
        try:
            version = operation.wait()
        except (NotFoundError, StateError) as error:
            self._ledger.broken.append(f"{operation.name}: {error}")
        except UnavailableError as error:
            if error.reason == "WORKER_LOST":
                self._ledger.note_end(operation.name, end_of(error))
            raise
        except RoelError as error:
            self._ledger.note_end(operation.name, end_of(error))
        else:
            self._ledger.note_end(operation.name, "SUCCEEDED")
            self._ledger.note_map(version)

    def _note(self, stream: str, told: Progress) -> None:
        self._ledger.note_events(stream, told.done_count)

    def _events(self) -> EventStream:
        return EventStream(
            t_us=np.sort(self._rng.integers(0, 1_000_000, EVENT_COUNT)),
            x=self._rng.integers(0, CAMERA.width, EVENT_COUNT).astype(np.uint16),
            y=self._rng.integers(0, CAMERA.height, EVENT_COUNT).astype(np.uint16),
            polarity=self._rng.choice(np.array([-1, 1], np.int8), EVENT_COUNT),
            width=CAMERA.width,
            height=CAMERA.height,
        )

    def _trajectory(self) -> Trajectory:
        rotation = rotation_from_vector(self._rng.normal(size=(200, 3)))
        poses = SE3(rotation=rotation, translation=self._rng.normal(size=(200, 3)))
        return Trajectory(t_us=np.arange(200) * 5000, T_world_camera=poses)


def _new_id() -> str:
    return f"crash-{uuid.uuid4().hex[:16]}"
