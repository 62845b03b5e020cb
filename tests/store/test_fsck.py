import pytest

from roel_service.errors import InputError, StateError
from roel_service.store import backup
from roel_service.store.backup import back_up
from roel_service.store.builds import BuiltVersion
from roel_service.store.fsck import check_folder
from roel_service.store.store import Store

from .samples import CAMERA, append, chunk, finalized, leased

BUILT = BuiltVersion(rlm_bytes=b"map", line_count=3, bounds_m=[0.0] * 6, report={})


@pytest.fixture
def full(store):
    """A frozen and an open recording, and a map with a built, a running and a failed version."""
    finalized(store)
    store.event_streams.create("open", CAMERA)
    append(store.event_streams, "open", chunk(0), chunk(1))
    store.maps.create("house")
    store.operations.succeed(leased(store, store.builds.begin("house", "walk")), BUILT)
    store.operations.preview(leased(store, store.builds.begin("house", "walk")), BUILT)
    store.operations.cancel(store.builds.begin("house", "walk").id)
    return store


def test_a_sound_folder_has_no_problems_also_while_it_is_served(full, folder):
    findings = check_folder(folder)
    assert findings.problems == []
    assert (findings.event_stream_count, findings.map_version_count) == (2, 3)
    assert (findings.operation_count, findings.blob_count) == (3, 3)


DAMAGES = {
    "missing map": ("delete", "map", "named by a row, but missing"),
    "changed map": ("change", "map", "its bytes have the digest"),
    "missing events": ("delete", "events", "its events are missing"),
    "changed events": ("change", "events", "is not what was acknowledged"),
    "cut append file": ("change", "open", "is not what was acknowledged"),
    "chunk": ("DELETE FROM event_chunk WHERE seq = 1", None, "chunk_count is 2"),
    "poses": ("UPDATE event_stream SET pose_count = 9", None, "pose_count is 9"),
    "task": ("DELETE FROM task WHERE state = 'leased'", None, "queued with 0 tasks to do"),
    "late task": ("UPDATE task SET state = 'ready'", None, "succeeded with 1 tasks to do"),
    "end": ("UPDATE operation SET end_time_us = 7", None, "state and end do not agree"),
    "version": (
        "UPDATE map_version SET state = 'creating' WHERE version = 1",
        None,
        "creating, but its operation has ended",
    ),
    "active": (
        "UPDATE map_version SET state = 'active' WHERE version = 2",
        None,
        "active, but its operation runs",
    ),
    "no file": ("UPDATE map_version SET sha256 = ''", None, "active without a map file"),
    "alias": (
        "INSERT INTO map_alias (map_id, alias, version) VALUES ('house', 'live', 9)",
        None,
        "live names v9, which does not exist",
    ),
    "count": ("UPDATE map SET version_count = 2", None, "its map counts 2 versions"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_every_damage_is_found(full, folder, damage):
    what, place, problem = DAMAGES[damage]
    if place is None:
        with full._database.write() as connection:
            connection.exec_driver_sql(what)
    else:
        streams = full.event_streams
        path = {
            "map": full._blobs.path(full.maps.version("house", 1).sha256),
            "events": streams.event_file(streams.get("walk")),
            "open": full._recordings.path(streams.get("open").uid),
        }[place]
        path.write_bytes(b"e") if what == "change" else path.unlink()
    assert any(problem in found for found in check_folder(folder).problems)


def test_a_folder_without_rows_is_no_data_folder(tmp_path):
    for check in (check_folder, lambda folder: back_up(folder, tmp_path / "copy")):
        with pytest.raises(InputError, match="expected a data folder"):
            check(tmp_path)


def test_a_folder_of_another_release_is_not_checked(full, folder):
    for version, reason in ((0, "DATA_TOO_OLD"), (99, "DATA_TOO_NEW")):
        with full._database.read() as connection:
            connection.exec_driver_sql(f"PRAGMA user_version = {version}")
        with pytest.raises(StateError) as caught:
            check_folder(folder)
        assert caught.value.reason == reason


def test_a_backup_takes_the_place_of_its_folder(full, folder, tmp_path):
    findings = back_up(folder, tmp_path / "copy")
    assert findings.problems == []
    with Store(tmp_path / "copy") as copy:
        assert copy.maps.map_file(copy.maps.version("house", 1)) == b"map"
        appended = append(copy.event_streams, "open", chunk(2))
        assert appended.chunk_count == 3
        assert len(copy.operations.unfinished()) == 1


def test_a_recording_that_is_frozen_while_it_is_copied_is_copied_again(
    full, folder, tmp_path, monkeypatch
):
    copy_rows = backup._copy_rows

    def copy_rows_then_finalize(source, target):
        copy_rows(source, target)
        full.event_streams.finalize("open")

    monkeypatch.setattr(backup, "_copy_rows", copy_rows_then_finalize)
    assert back_up(folder, tmp_path / "copy").problems == []


def test_the_copy_of_a_folder_with_a_problem_is_no_backup(full, folder, tmp_path):
    full._blobs.path(full.maps.version("house", 1).sha256).unlink()
    with pytest.raises(StateError, match="missing") as caught:
        back_up(folder, tmp_path / "copy")
    assert caught.value.reason == "BACKUP_OUTDATED"
