from roel_service.scene.camera import Camera
from roel_service.store.event_streams import Chunk, PosePart

CAMERA = Camera(width=8, height=6, fx_px=5.0, fy_px=5.0, cx_px=4.0, cy_px=3.0)
LIMIT_BYTES = 1 << 20


def chunk(seq, data=b"events", t0_us=None, t1_us=None, event_count=3):
    start_us = 1000 * seq if t0_us is None else t0_us
    return Chunk(
        seq=seq,
        t0_us=start_us,
        t1_us=start_us + 900 if t1_us is None else t1_us,
        event_count=event_count,
        data=data,
    )


def pose_part(t0_us=0, t1_us=10_000, pose_count=3, data=b"poses"):
    return PosePart(t0_us=t0_us, t1_us=t1_us, pose_count=pose_count, data=data)


def finalized(store, stream_id="walk", data=b"events", poses=b"poses"):
    store.event_streams.create(stream_id, CAMERA)
    store.event_streams.append_chunks(stream_id, [chunk(0, data)], LIMIT_BYTES)
    store.event_streams.append_poses(stream_id, pose_part(data=poses), max_pose_count=100)
    return store.event_streams.finalize(stream_id)


def leased(store, operation):
    """The lease of an operation's task, which is the next one."""
    task = store.tasks.lease("tests")
    assert task.operation_id == operation.id
    return task.lease
