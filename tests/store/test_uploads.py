import hashlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from roel_service.errors import (
    ConflictError,
    CorruptionError,
    InputError,
    LimitError,
    NotFoundError,
    StateError,
)
from roel_service.store import uploads as uploads_module
from roel_service.store.retention import DAY_US
from roel_service.store.store import Store
from roel_service.store.uploads import Part

DATA = bytes(range(10))
SHA256 = hashlib.sha256(DATA).hexdigest()


def begin(store, upload_id="walk", data=DATA, count=8):
    sha256 = hashlib.sha256(data).hexdigest()
    return store.uploads.take_over(upload_id, sha256, len(data), count)


def part(start, stop, data=DATA):
    return Part(offset=start, data=data[start:stop])


def test_parts_become_a_blob(store):
    record = begin(store)
    record = store.uploads.append("walk", record.fence, [part(0, 4), part(4, 7)])
    assert record.committed_bytes == store.uploads.get("walk").committed_bytes == 7
    store.uploads.append("walk", record.fence, [part(7, 10)])
    blob = store.uploads.finish("walk", record.fence)
    assert (blob.sha256, blob.size_bytes) == (SHA256, 10)
    assert store.uploads.path(store.uploads.use(SHA256)).read_bytes() == DATA
    with pytest.raises(NotFoundError):
        store.uploads.get("walk")


def test_a_blob_may_be_empty(store):
    record = begin(store, data=b"")
    assert store.uploads.finish("walk", record.fence).size_bytes == 0


def test_a_writer_that_was_replaced_appends_no_more(store):
    first, second = begin(store), begin(store)
    for late in (
        lambda: store.uploads.append("walk", first.fence, [part(0, 4)]),
        lambda: store.uploads.finish("walk", first.fence),
    ):
        with pytest.raises(ConflictError) as caught:
            late()
        assert caught.value.reason == "WRITER_REPLACED"
    assert store.uploads.append("walk", second.fence, [part(0, 4)]).committed_bytes == 4


def test_an_upload_id_belongs_to_one_blob(store):
    begin(store)
    with pytest.raises(ConflictError) as caught:
        begin(store, data=b"other")
    assert caught.value.reason == "ALREADY_EXISTS"


@pytest.mark.parametrize(
    ("late", "kind", "reason"),
    [
        (part(5, 7), StateError, "SEQUENCE_GAP"),
        (Part(offset=1, data=b"xy"), ConflictError, "CHUNK_CONFLICT"),
        (Part(offset=3, data=b"\3\4\5\6\7\x08\x09\x0a"), InputError, "PART_INVALID"),
        (Part(offset=-1, data=b"x"), InputError, "PART_INVALID"),
    ],
)
def test_parts_that_do_not_continue_are_refused(store, late, kind, reason):
    record = begin(store)
    store.uploads.append("walk", record.fence, [part(0, 4)])
    with pytest.raises(kind) as caught:
        store.uploads.append("walk", record.fence, [late])
    assert caught.value.reason == reason
    assert store.uploads.get("walk").committed_bytes == 4


def test_a_gap_names_the_offset_that_is_expected(store):
    record = begin(store)
    store.uploads.append("walk", record.fence, [part(0, 4)])
    with pytest.raises(StateError, match="offset: expected 4, found 10"):
        store.uploads.finish("walk", record.fence)


def test_bytes_of_another_digest_are_no_blob(store):
    record = begin(store)
    store.uploads.append("walk", record.fence, [Part(offset=0, data=b"x" * 10)])
    with pytest.raises(CorruptionError, match=SHA256):
        store.uploads.finish("walk", record.fence)
    with pytest.raises(NotFoundError):
        store.uploads.use(SHA256)
    assert begin(store).committed_bytes == 0


def test_there_are_only_so_many_uploads(store):
    begin(store, "first", count=1)
    with pytest.raises(LimitError) as caught:
        begin(store, "second", count=1)
    assert caught.value.reason == "TOO_MANY_UPLOADS"


def test_what_nobody_continues_is_forgotten_after_a_day(store, folder, monkeypatch):
    begin(store, "old", b"old")
    record = begin(store)
    store.uploads.append("walk", record.fence, [part(0, 10)])
    store.uploads.finish("walk", record.fence)
    store.collect_garbage(unused_for_s=0)
    assert store.uploads.use(SHA256)
    later = uploads_module.now_us() + DAY_US
    monkeypatch.setattr(uploads_module, "now_us", lambda: later)
    begin(store, "new")
    assert [path.stem for path in (folder / "uploads").iterdir()] == ["new"]
    store.collect_garbage(unused_for_s=0)
    with pytest.raises(NotFoundError):
        store.uploads.use(SHA256)


def test_files_of_uploads_that_have_ended_go_at_the_next_start(folder):
    with Store(folder) as store:
        fence = begin(store).fence
        store.uploads.append("walk", fence, [part(0, 4)])
    files = folder / "uploads"
    (files / "ended.upload").write_bytes(b"x")
    with (files / "walk.upload").open("ab") as file:
        file.write(b"torn")
    with Store(folder):
        assert [(path.stem, path.read_bytes()) for path in files.iterdir()] == [("walk", DATA[:4])]


# Each example opens a folder.
@settings(max_examples=10, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 10), st.integers(0, 10)), max_size=5))
def test_any_way_of_sending_gives_the_same_blob(tmp_path_factory, cuts):
    """However parts are cut and repeated, whoever writes them, what is stored is their sequence."""
    with Store(tmp_path_factory.mktemp("data")) as store:
        record = begin(store)
        for start, stop in [*cuts, (0, len(DATA))]:
            fence, committed = begin(store).fence, record.committed_bytes
            sent = part(min(start, committed), stop)
            record = store.uploads.append("walk", fence, [sent])
            assert record.committed_bytes == max(committed, sent.offset + len(sent.data))
        store.uploads.finish("walk", record.fence)
        assert store.uploads.path(store.uploads.use(SHA256)).read_bytes() == DATA
