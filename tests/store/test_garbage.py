import os
import sqlite3
import time
from contextlib import closing

import pytest

from roel_service.store.builds import BuiltVersion
from roel_service.store.store import Store

from .samples import finalized, leased

BUILT = BuiltVersion(rlm_bytes=b"map", line_count=3, bounds_m=[0.0] * 6, report={})


@pytest.fixture
def full(store):
    """A folder with a recording and a map."""
    finalized(store)
    store.maps.create("house")
    store.operations.succeed(leased(store, store.builds.begin("house", "walk")), BUILT)
    return store


def stored(store):
    return {blob.sha256 for blob in store._blobs.stored()}


def test_what_rows_name_stays(full):
    before = stored(full)
    swept = full.collect_garbage(unused_for_s=-1.0)
    assert (swept.deleted_blob_count, swept.kept_blob_count) == (0, 3)
    assert stored(full) == before


def test_what_nobody_names_goes_when_no_upload_can_need_it_any_more(full):
    loose = full._blobs.put(b"loose")
    assert full.collect_garbage().deleted_blob_count == 0
    swept = full.collect_garbage(unused_for_s=-1.0)
    assert (swept.deleted_blob_count, swept.deleted_bytes) == (1, 5)
    assert loose not in stored(full)


def test_a_blob_that_is_put_again_is_new(full):
    loose = full._blobs.put(b"loose")
    os.utime(full._blobs.path(loose), (0, 0))
    assert full._blobs.put(b"loose") == loose
    assert full.collect_garbage(unused_for_s=60.0).deleted_blob_count == 0


def test_a_blob_that_is_put_while_it_is_being_deleted_stays(full, monkeypatch):
    loose = full._blobs.put(b"loose")
    path = full._blobs.path(loose)
    os.utime(path, (0, 0))
    look = type(path).rename

    def rename(self, target):
        os.utime(self)
        return look(self, target)

    monkeypatch.setattr(type(path), "rename", rename)
    assert not full._blobs.discard(loose, time.time() - 60.0)
    assert full._blobs.read(loose) == b"loose"


def test_what_a_crash_left_between_the_two_looks_comes_back(full, folder):
    named = full.maps.version("house", 1).sha256
    path = full._blobs.path(named)
    path.rename(folder / "blobs" / "sha256" / f"{named}.part")
    full._blobs.recover()
    assert full._blobs.read(named) == b"map"


def test_inputs_of_an_unfinished_task_stay(full):
    loose = full._blobs.put(b"loose")
    operation = full.builds.begin("house", "walk")
    with full._database.write() as connection:
        connection.exec_driver_sql(
            "UPDATE task SET inputs = ? WHERE operation_id = ?", (f'["{loose}"]', operation.id)
        )
    assert full.collect_garbage(unused_for_s=-1.0).deleted_blob_count == 0
    full.operations.cancel(operation.id)
    assert full.collect_garbage(unused_for_s=-1.0).deleted_blob_count == 1


def test_deleted_recordings_and_expired_operations_leave_nothing_behind(full, folder):
    full.event_streams.delete("walk")
    with closing(sqlite3.connect(folder / "rows.sqlite")) as connection, connection:
        connection.execute("UPDATE operation SET expire_time_us = 1")
    assert full.collect_garbage(unused_for_s=-1.0).deleted_blob_count == 2
    assert full.operations.page("", 10) == []
    assert stored(full) == {full.maps.version("house", 1).sha256}


def test_starting_deletes_no_blob(folder):
    with Store(folder) as store:
        loose = store._blobs.put(b"loose")
    with Store(folder) as store:
        assert stored(store) == {loose}
