import hashlib

from roel_service.scene.camera import Camera
from roel_service.store.event_streams import Chunk, PosePart

CAMERA = Camera(width=8, height=6, fx_px=5.0, fy_px=5.0, cx_px=4.0, cy_px=3.0)
LIMIT_BYTES = 1 << 20


def chunk(seq, data=b"events", t0_us=None, t1_us=None, event_count=3, longest_step_us=0):
    start_us = 1000 * seq if t0_us is None else t0_us
    return Chunk(
        seq=seq,
        t0_us=start_us,
        t1_us=start_us + 900 if t1_us is None else t1_us,
        event_count=event_count,
        longest_step_us=longest_step_us,
        data=data,
        length=len(data),
        sha256=hashlib.sha256(data).hexdigest(),
    )


def pose_part(t0_us=0, t1_us=10_000, pose_count=3, data=b"poses", covered_us=None):
    spans_us = [[t0_us, t1_us]] if covered_us is None else covered_us
    return PosePart(t0_us=t0_us, t1_us=t1_us, pose_count=pose_count, covered_us=spans_us, data=data)


def append(streams, stream_id, *chunks, limit_bytes=LIMIT_BYTES):
    """Append as a new writer."""
    fence = streams.take_over(stream_id).fence
    return streams.append_chunks(stream_id, fence, chunks, limit_bytes)


def finalized(store, stream_id="walk", data=b"events", poses=b"poses"):
    store.event_streams.create(stream_id, CAMERA)
    append(store.event_streams, stream_id, chunk(0, data))
    store.event_streams.append_poses(stream_id, pose_part(data=poses), max_pose_count=100)
    return store.event_streams.finalize(stream_id)


def leased(store, operation):
    """The lease of an operation's task, which is the next one."""
    task = store.tasks.lease("tests")
    assert task.operation_id == operation.id
    return task.lease
