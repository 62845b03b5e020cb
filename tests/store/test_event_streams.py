import hashlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from roel_service.errors import (
    ConflictError,
    CorruptionError,
    EventsError,
    LimitError,
    NotFoundError,
    StateError,
    TrajectoryError,
)
from roel_service.scene.camera import Camera, CameraModel
from roel_service.store.records import StreamState
from roel_service.store.store import Store

from . import samples
from .samples import CAMERA, LIMIT_BYTES, chunk, finalized, pose_part


@pytest.fixture
def streams(store):
    store.event_streams.create("walk", CAMERA)
    return store.event_streams


def append(streams, *chunks, limit_bytes=LIMIT_BYTES):
    return samples.append(streams, "walk", *chunks, limit_bytes=limit_bytes)


def test_a_new_recording_is_open_and_empty(streams):
    record = streams.get("walk")
    assert record.state is StreamState.OPEN
    assert (record.chunk_count, record.event_count, record.pose_count) == (0, 0, 0)
    assert record.digest == ""


def test_a_fisheye_camera_is_remembered_exactly(store):
    camera = Camera(
        width=640,
        height=480,
        fx_px=0.1 + 0.2,
        fy_px=300.0,
        cx_px=-1.5,
        cy_px=1e-9,
        model=CameraModel.FISHEYE,
        distortion=(0.1, -0.2, 1 / 3, 0.0),
    )
    store.event_streams.create("fish", camera)
    assert store.event_streams.get("fish").camera == camera


def test_an_id_in_use_is_refused(streams):
    with pytest.raises(ConflictError) as caught:
        streams.create("walk", CAMERA)
    assert caught.value.reason == "ALREADY_EXISTS"


def test_appending_counts_chunks_events_bytes_and_time(streams):
    append(streams, chunk(0, b"one", event_count=5), chunk(1, b"three", event_count=7))
    record = append(streams, chunk(2, b"x", event_count=1))
    assert (record.chunk_count, record.event_count, record.size_bytes) == (3, 13, 9)
    assert (record.start_us, record.end_us) == (0, 2900)
    assert streams.get("walk") == record
    assert streams.chunk_lengths(record) == [3, 5, 1]


def test_a_recording_may_begin_before_zero(streams):
    record = append(streams, chunk(0, t0_us=-500, t1_us=-100), chunk(1, t0_us=-100, t1_us=3))
    assert (record.start_us, record.end_us) == (-500, 3)


def test_equal_chunks_sent_again_change_nothing(streams):
    record = append(streams, chunk(0), chunk(1))
    assert streams.append_chunks("walk", record.fence, [chunk(0)], LIMIT_BYTES) == record
    assert append(streams, chunk(0), chunk(1), chunk(2)).chunk_count == 3


def test_another_chunk_under_a_used_number_is_a_conflict(streams):
    append(streams, chunk(0))
    with pytest.raises(ConflictError) as caught:
        append(streams, chunk(0, b"other"))
    assert caught.value.reason == "CHUNK_CONFLICT"


def test_a_gap_names_the_number_that_is_expected(streams):
    append(streams, chunk(0))
    with pytest.raises(StateError, match="seq: expected 1, found 2") as caught:
        append(streams, chunk(2))
    assert caught.value.reason == "SEQUENCE_GAP"


def test_chunks_that_go_back_in_time_are_refused_whole(streams):
    append(streams, chunk(0))
    with pytest.raises(EventsError, match="events from 1900 us on, found 1899 us"):
        append(streams, chunk(1), chunk(2, t0_us=1899))
    assert streams.get("walk").chunk_count == 1


def test_a_recording_beyond_the_limit_is_refused(streams):
    append(streams, chunk(0, b"12345678"), limit_bytes=10)
    with pytest.raises(LimitError, match="at most 10 bytes of events, found 11"):
        append(streams, chunk(1, b"123"), limit_bytes=10)


def test_the_writer_that_was_replaced_appends_no_more(streams):
    first = streams.take_over("walk").fence
    streams.append_chunks("walk", first, [chunk(0)], LIMIT_BYTES)
    second = streams.take_over("walk").fence
    with pytest.raises(ConflictError) as caught:
        streams.append_chunks("walk", first, [chunk(1, b"late")], LIMIT_BYTES)
    assert caught.value.reason == "WRITER_REPLACED"
    assert streams.append_chunks("walk", second, [chunk(1)], LIMIT_BYTES).chunk_count == 2


def test_the_longest_gap_is_inside_a_chunk_or_between_two(streams):
    record = append(streams, chunk(0, longest_step_us=40), chunk(1, longest_step_us=70))
    assert record.longest_gap_us == 100
    record = append(streams, chunk(2, longest_step_us=650), chunk(3))
    assert record.longest_gap_us == 650
    assert append(streams, chunk(4, t0_us=9000)).longest_gap_us == 9000 - 3900


def test_spans_of_poses_join_where_no_gap_divides_them(streams):
    parts = [
        pose_part(0, 2_000_000, covered_us=[[0, 400_000], [1_000_000, 2_000_000]]),
        pose_part(2_500_000, 3_000_000),
        pose_part(3_500_001, 4_000_000),
    ]
    for part in parts:
        record = streams.append_poses("walk", part, 100)
    covered_us = [[0, 400_000], [1_000_000, 3_000_000], [3_500_001, 4_000_000]]
    assert streams.covered_us(record) == covered_us


def test_poses_must_follow_the_stored_ones(streams):
    assert streams.append_poses("walk", pose_part(0, 500), 100).pose_count == 3
    with pytest.raises(TrajectoryError, match="poses after 500 us, found 500 us"):
        streams.append_poses("walk", pose_part(500, 900), 100)
    assert streams.append_poses("walk", pose_part(501, 900, data=b"more"), 100).pose_count == 6
    paths = streams.pose_files(streams.get("walk"))
    assert [path.read_bytes() for path in paths] == [b"poses", b"more"]


def test_too_many_poses_are_refused(streams):
    streams.append_poses("walk", pose_part(0, 5), 5)
    with pytest.raises(LimitError, match="at most 5, found 6"):
        streams.append_poses("walk", pose_part(6, 9), 5)


def test_finalizing_seals_the_chunks_under_their_digest(streams):
    append(streams, chunk(0, b"one"), chunk(1, b"two"))
    record = streams.finalize("walk")
    assert record.state is StreamState.FINALIZED
    assert record.digest == hashlib.sha256(b"onetwo").hexdigest()
    assert streams.event_file(record).read_bytes() == b"onetwo"
    assert streams.finalize("walk") == record


@pytest.mark.parametrize(
    "late",
    [
        lambda streams: append(streams, chunk(1)),
        lambda streams: streams.append_poses("walk", pose_part(), 100),
    ],
)
def test_a_finalized_recording_takes_nothing_more(streams, late):
    append(streams, chunk(0))
    streams.finalize("walk")
    with pytest.raises(StateError) as caught:
        late(streams)
    assert caught.value.reason == "STREAM_FINALIZED"


def test_a_recording_without_events_cannot_be_finalized(streams):
    with pytest.raises(EventsError) as caught:
        streams.finalize("walk")
    assert caught.value.reason == "NO_EVENTS"


def test_a_deleted_recording_is_gone_with_its_files(store, folder):
    finalized(store)
    store.event_streams.create("open", CAMERA)
    for stream_id in ("walk", "open"):
        store.event_streams.delete(stream_id)
        with pytest.raises(NotFoundError):
            store.event_streams.get(stream_id)
    store.collect_garbage(unused_for_s=-1.0)
    stored = [*(folder / "blobs").rglob("*"), *(folder / "recordings").iterdir()]
    assert not [path for path in stored if path.is_file()]


def test_a_blob_that_two_recordings_share_outlives_the_first(store):
    finalized(store, "first")
    second = finalized(store, "second")
    store.event_streams.delete("first")
    assert store.event_streams.event_file(second).read_bytes() == b"events"


def test_a_recording_that_a_build_reads_stays(store):
    finalized(store)
    store.maps.create("map")
    operation = store.builds.begin("map", "walk")
    with pytest.raises(StateError) as caught:
        store.event_streams.delete("walk")
    assert caught.value.reason == "STREAM_IN_USE"
    store.operations.cancel(operation.id)
    store.event_streams.delete("walk")


def test_pages_follow_the_order_of_ids(store):
    for stream_id in ("ccc", "aaa", "bbb"):
        store.event_streams.create(stream_id, CAMERA)
    assert [item.id for item in store.event_streams.page("", 2)] == ["aaa", "bbb"]
    assert [item.id for item in store.event_streams.page("bbb", 2)] == ["ccc"]


def test_bytes_that_were_never_committed_are_cut_away(folder):
    with Store(folder) as store:
        uid = store.event_streams.create("walk", CAMERA).uid
        append(store.event_streams, chunk(0, b"one"))
    with (folder / "recordings" / f"{uid}.rec").open("ab") as file:
        file.write(b"torn")
    with Store(folder) as store:
        assert (folder / "recordings" / f"{uid}.rec").read_bytes() == b"one"
        append(store.event_streams, chunk(1, b"two"))
        record = store.event_streams.finalize("walk")
        assert store.event_streams.event_file(record).read_bytes() == b"onetwo"


# Each example opens a folder several times.
@settings(max_examples=10, deadline=None)
@given(st.data())
def test_any_way_of_sending_gives_the_same_recording(tmp_path_factory, data):
    """However chunks are grouped, repeated and interrupted, what is stored is their sequence."""
    chunks = [chunk(seq, bytes([65 + seq]) * (seq + 1)) for seq in range(6)]
    folder = tmp_path_factory.mktemp("data")
    with Store(folder) as store:
        store.event_streams.create("walk", CAMERA)
    while True:
        with Store(folder) as store:
            held = store.event_streams.get("walk").chunk_count
            if held == len(chunks):
                break
            first = data.draw(st.integers(0, held))
            last = data.draw(st.integers(held + 1, len(chunks)))
            append(store.event_streams, *chunks[first:last])
    with Store(folder) as store:
        record = store.event_streams.finalize("walk")
        content = store.event_streams.event_file(record).read_bytes()
    assert content == b"".join(item.data for item in chunks)


def seqs_between(streams, start_us, stop_us):
    with streams.reading(streams.get("walk")) as reader:
        return [item.seq for item in reader.chunks(start_us, stop_us)]


def test_chunks_of_a_time_range_are_found(streams):
    """Chunks of 900 us begin every 1000 us; three more share one time."""
    same = [chunk(seq, t0_us=3000, t1_us=3000) for seq in (3, 4, 5)]
    append(streams, *(chunk(seq) for seq in range(3)), *same, chunk(6, t0_us=3000))
    assert seqs_between(streams, -5, 9000) == [0, 1, 2, 3, 4, 5, 6]
    assert seqs_between(streams, 1900, 1901) == [1]
    assert seqs_between(streams, 1901, 2000) == []
    assert seqs_between(streams, 500, 1001) == [0, 1]
    assert seqs_between(streams, 3000, 3001) == [3, 4, 5, 6]
    assert seqs_between(streams, 3500, 4000) == [6]


def test_a_recording_that_is_frozen_and_deleted_is_read_to_its_end(streams):
    append(streams, chunk(0, b"one"))
    record = streams.get("walk")
    with streams.reading(record) as reader:
        streams.finalize("walk")
        assert [item.data for item in reader.chunks(0, 1000)] == [b"one"]
    with streams.reading(record) as reader:
        assert [item.data for item in reader.chunks(0, 1000)] == [b"one"]
    streams.delete("walk")
    with pytest.raises(NotFoundError), streams.reading(record):
        pass


def test_changed_bytes_are_never_read(streams, folder):
    uid = append(streams, chunk(0, b"right")).uid
    (folder / "recordings" / f"{uid}.rec").write_bytes(b"wrong")
    with pytest.raises(CorruptionError, match="chunk 0"):
        seqs_between(streams, 0, 1000)
