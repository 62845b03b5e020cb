"""Servers as processes, and recordings to send to them."""

import dataclasses
import json
import os
import subprocess
import sys
import time
import uuid
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np

from roel_service.config.presets import preset
from roel_service.geometry.se3 import SE3, rotation_from_vector
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventStream
from roel_service.scene.trajectory import Trajectory

SCRIPT = Path(__file__).with_name("run_server.py")
CAMERA = Camera(width=64, height=48, fx_px=50.0, fy_px=50.0, cx_px=32.0, cy_px=24.0)


class Server:
    """A server process on a folder; `log` is what it wrote to stderr so far."""

    def __init__(self, folder, port=0, listen=None, **settings):
        self.folder = folder
        self.folder.mkdir(exist_ok=True)
        self._log_file = folder.with_suffix(".log")
        self.pid_file = folder.with_suffix(".pid")
        environment = {**os.environ, "SAMPLE_BUILD_PID": str(self.pid_file)}
        command = [sys.executable, SCRIPT, folder, json.dumps({"port": port, **(listen or {})})]
        command.append(json.dumps(settings))
        with self._log_file.open("ab") as log:
            self.process = subprocess.Popen(
                command, stdout=subprocess.PIPE, stderr=log, text=True, env=environment
            )
        told = self.process.stdout.readline().split()
        assert told, self.log
        self.address, self.admin = told

    @property
    def log(self):
        return self._log_file.read_text()

    @property
    def port(self):
        return int(self.address.rpartition(":")[2])

    def child_pid(self):
        """Process id of the slow build, once it runs."""
        wait_until(self.pid_file.exists)
        return int(self.pid_file.read_text())

    def kill(self):
        self.process.kill()
        self._end()

    def stop(self):
        self.process.terminate()
        return self._end()

    def _end(self):
        with self.process:
            return self.process.wait(30)


@contextmanager
def servers(folder):
    """A function that starts servers on one folder; none of them outlives the block."""
    with ExitStack() as started:

        def start(**options):
            server = Server(folder, **options)
            started.callback(server.kill)
            return server

        yield start


def wait_until(condition, timeout_s=30.0):
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "it never came true"
        time.sleep(0.02)


def events_of(count, seed=0, duration_us=1_000_000, camera=CAMERA):
    rng = np.random.default_rng(seed)
    return EventStream(
        t_us=np.sort(rng.integers(0, duration_us, count)),
        x=rng.integers(0, camera.width, count).astype(np.uint16),
        y=rng.integers(0, camera.height, count).astype(np.uint16),
        polarity=rng.choice(np.array([-1, 1], np.int8), count),
        width=camera.width,
        height=camera.height,
    )


def trajectory_of(count, seed=0):
    rng = np.random.default_rng(seed)
    rotation = rotation_from_vector(rng.normal(size=(count, 3)))
    poses = SE3(rotation=rotation, translation=rng.normal(size=(count, 3)))
    return Trajectory(t_us=np.arange(count) * 5000, T_world_camera=poses)


def config_of(seed):
    config = preset("default")
    return dataclasses.replace(config, runtime=dataclasses.replace(config.runtime, seed=seed))


def new_id():
    return f"test-{uuid.uuid4().hex[:12]}"


def ready_recording(client, event_count=1000):
    """Name of a finalized recording with poses."""
    stream = client.create_event_stream(new_id(), CAMERA)
    client.upload_poses(stream, trajectory_of(5))
    client.upload_events(stream, events_of(event_count))
    client.finalize(stream)
    return stream
