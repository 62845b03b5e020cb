import sqlite3
from contextlib import closing

import pytest

from roel_service.errors import InputError, StateError
from roel_service.store.store import Store

from .samples import CAMERA, finalized


def test_everything_is_there_after_opening_again(folder):
    with Store(folder) as store:
        stream = finalized(store)
        store.maps.create("house")
        operation = store.builds.begin("house", "walk")
    with Store(folder) as store:
        assert store.event_streams.get("walk") == stream
        assert store.event_streams.event_file(stream).read_bytes() == b"events"
        assert store.operations.unfinished() == [operation]


def test_a_folder_belongs_to_one_process_at_a_time(store, folder):
    with pytest.raises(StateError) as caught:
        Store(folder)
    assert caught.value.reason == "DATA_IN_USE"
    assert str(folder) in str(caught.value)


def test_a_file_is_no_data_folder(tmp_path):
    file = tmp_path / "file"
    file.write_text("not a folder")
    for place in (file, file / "below"):
        with pytest.raises(InputError, match="expected a data folder"):
            Store(place)


def test_a_closed_folder_can_be_opened_again(folder):
    for _ in range(2):
        with Store(folder):
            pass


def test_a_folder_of_a_newer_release_is_refused(folder):
    with Store(folder):
        pass
    with closing(sqlite3.connect(folder / "rows.sqlite")) as connection:
        connection.execute("PRAGMA user_version = 99")
    with pytest.raises(StateError) as caught:
        Store(folder)
    assert caught.value.reason == "DATA_TOO_NEW"


def test_append_files_that_no_row_names_go_at_the_next_start(folder):
    with Store(folder) as store:
        stream = finalized(store)
        opened = store.event_streams.create("open", CAMERA)
    stray_recording = folder / "recordings" / f"{stream.uid}.rec"
    stray_recording.write_bytes(b"stray")
    with Store(folder) as store:
        assert not stray_recording.exists()
        assert store.event_streams.event_file(stream).exists()
        assert (folder / "recordings" / f"{opened.uid}.rec").exists()


def test_a_store_whose_folder_went_tells_so(store, folder, tmp_path):
    assert store.problems() == []
    folder.rename(tmp_path / "elsewhere")
    assert store.problems() == ["the data folder cannot be written"]
    (tmp_path / "elsewhere").rename(folder)
