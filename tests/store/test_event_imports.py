import hashlib

import pytest

from roel_service.errors import ConflictError, NotFoundError, StateError
from roel_service.store.event_imports import ImportedEvents
from roel_service.store.records import OperationState
from roel_service.store.uploads import Part

from .samples import CAMERA, append, chunk, leased

FILE = b"a file of events"
SHA256 = hashlib.sha256(FILE).hexdigest()


@pytest.fixture
def imports(store):
    store.event_streams.create("walk", CAMERA)
    fence = store.uploads.take_over("file", SHA256, len(FILE), 1).fence
    store.uploads.append("file", fence, [Part(offset=0, data=FILE)])
    store.uploads.finish("file", fence)
    return store.event_imports


def imported(store, *chunks, fence=1):
    """What the child of an import leaves behind."""
    file = store.scratch_file("chunks")
    file.write_bytes(b"".join(item.data for item in chunks))
    return ImportedEvents(fence=fence, file=file, chunks=chunks)


def test_an_import_fills_the_recording(store, imports):
    assert imports.blob_path(SHA256).read_bytes() == FILE
    lease = leased(store, imports.begin("walk", SHA256))
    outcome = imported(store, chunk(0, b"one", longest_step_us=7), chunk(1, b"three"))
    assert store.operations.succeed(lease, outcome).state is OperationState.SUCCEEDED
    record = store.event_streams.get("walk")
    assert (record.chunk_count, record.event_count, record.size_bytes) == (2, 6, 8)
    assert (record.start_us, record.end_us, record.longest_gap_us) == (0, 1900, 100)
    append(store.event_streams, "walk", chunk(2, b"x"))
    sealed = store.event_streams.finalize("walk")
    assert store.event_streams.event_file(sealed).read_bytes() == b"onethreex"


def test_an_import_needs_a_blob_and_an_open_recording_without_events(store, imports):
    with pytest.raises(NotFoundError, match="blob"):
        imports.begin("walk", "0" * 64)
    append(store.event_streams, "walk", chunk(0))
    with pytest.raises(StateError) as filled:
        imports.begin("walk", SHA256)
    assert filled.value.reason == "STREAM_NOT_EMPTY"
    store.event_streams.finalize("walk")
    with pytest.raises(StateError) as frozen:
        imports.begin("walk", SHA256)
    assert frozen.value.reason == "STREAM_FINALIZED"


def test_whoever_writes_is_replaced_by_an_import_and_replaces_it(store, imports):
    streams = store.event_streams
    before = streams.take_over("walk")
    lease = leased(store, imports.begin("walk", SHA256))
    with pytest.raises(ConflictError) as late:
        streams.append_chunks("walk", before.fence, [chunk(0)], 100)
    streams.take_over("walk")
    with pytest.raises(ConflictError) as lost:
        store.operations.succeed(lease, imported(store, chunk(0), fence=2))
    assert late.value.reason == lost.value.reason == "WRITER_REPLACED"
    assert streams.get("walk").chunk_count == 0


def test_a_recording_that_is_filled_is_not_deleted(store, imports):
    imports.begin("walk", SHA256)
    with pytest.raises(StateError) as caught:
        store.event_streams.delete("walk")
    assert caught.value.reason == "STREAM_IN_USE"
