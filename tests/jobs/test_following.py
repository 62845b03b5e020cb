import hashlib
import threading
import time

import numpy as np
import pytest

from roel_service.config.presets import preset
from roel_service.errors import StateError
from roel_service.geometry.se3 import SE3
from roel_service.jobs.build import build_map, run_build
from roel_service.jobs.following import follow
from roel_service.jobs.inputs import FollowParameters
from roel_service.jobs.task import Partial
from roel_service.mapping.ahead import lines_ahead
from roel_service.mapping.frames import frame_times
from roel_service.progress import ignore
from roel_service.scene.trajectory import Trajectory
from roel_service.store.event_streams import Chunk, PosePart
from roel_service.store.store import Store
from roel_service.wire.chunks import encode_chunk
from roel_service.wire.nouns import trajectory_to_proto

from . import wireframe
from .test_build import Pieces

CONFIG = preset("default")
CHUNK_COUNT = 12


@pytest.fixture(scope="module")
def events():
    return wireframe.events()


@pytest.fixture
def store(tmp_path):
    with Store(tmp_path / "data") as opened:
        opened.event_streams.create("walk", wireframe.CAMERA)
        yield opened


def parameters(store, patience_s=30.0):
    return FollowParameters(
        folder=store.folder, stream_id="walk", config=CONFIG, patience_s=patience_s
    )


def append_poses(store):
    trajectory = wireframe.trajectory()
    first_us, last_us = int(trajectory.t_us[0]), int(trajectory.t_us[-1])
    part = PosePart(
        t0_us=first_us,
        t1_us=last_us,
        pose_count=len(trajectory),
        covered_us=[[first_us, last_us]],
        data=trajectory_to_proto(trajectory).SerializeToString(),
    )
    store.event_streams.append_poses("walk", part, 10_000)


def append_events(store, events, pause_s=0.0):
    """All events, in many commits."""
    fence = store.event_streams.take_over("walk").fence
    pieces = Pieces(events, len(events) // CHUNK_COUNT + 1)
    for seq, piece in enumerate(pieces.chunks()):
        data = encode_chunk(piece)
        chunk = Chunk(
            seq=seq,
            t0_us=int(piece.t_us[0]),
            t1_us=int(piece.t_us[-1]),
            event_count=len(piece),
            longest_step_us=0,
            length=len(data),
            data=data,
            sha256=hashlib.sha256(data).hexdigest(),
        )
        store.event_streams.append_chunks("walk", fence, [chunk], 1 << 30)
        time.sleep(pause_s)


@pytest.mark.parametrize("poses_come", ["first", "last"])
def test_a_build_that_follows_an_upload_makes_the_same_map(store, events, poses_come):
    whole = build_map(Pieces(events, 5000), wireframe.trajectory(), wireframe.CAMERA, CONFIG)
    looked_at = threading.Event()

    def upload():
        if poses_come == "first":
            append_poses(store)
        append_events(store, events)
        if poses_come == "first":
            # Something has been found before the recording is complete.
            assert looked_at.wait(60)
        else:
            append_poses(store)
        store.event_streams.finalize("walk")

    def note(news):
        told.append(news)
        looked_at.set()

    told = []
    uploading = threading.Thread(target=upload)
    uploading.start()
    version = run_build(parameters(store), note)
    uploading.join()
    assert version.rlm_bytes == whole.rlm_bytes
    assert any(isinstance(news, Partial) for news in told)


class Growing:
    """Events in pieces, each with just the poses that reach past its end."""

    def __init__(self, events):
        self._events = events

    def chunks(self):
        whole = wireframe.trajectory()
        for piece in Pieces(self._events, 4000).chunks():
            count = int(np.searchsorted(whole.t_us, piece.t_us[-1])) + 1
            poses = SE3(
                rotation=whole.T_world_camera.rotation[:count],
                translation=whole.T_world_camera.translation[:count],
            )
            yield piece, Trajectory(t_us=whole.t_us[:count], T_world_camera=poses)


def test_every_frame_can_be_looked_at_ahead(events):
    known = lines_ahead(Growing(events), wireframe.CAMERA, CONFIG, ignore)
    times_us = frame_times(wireframe.trajectory(), Pieces.time_range_us, CONFIG.frames)
    assert sorted(known) == list(enumerate(times_us))
    inputs = Pieces(events, 5000), wireframe.trajectory(), wireframe.CAMERA, CONFIG
    assert build_map(*inputs, known=known).rlm_bytes == build_map(*inputs).rlm_bytes


def test_an_upload_that_stands_still_is_given_up(store):
    with pytest.raises(StateError, match="an upload that goes on") as caught:
        follow(parameters(store, patience_s=0.1), ignore)
    assert caught.value.reason == "STREAM_NOT_FINALIZED"


def test_a_followed_recording_needs_poses_in_the_end(store, events):
    append_events(store, events)
    store.event_streams.finalize("walk")
    with pytest.raises(StateError) as caught:
        follow(parameters(store), ignore)
    assert caught.value.reason == "NO_POSES"
