import sqlite3
from contextlib import closing

import pytest

from roel_service.errors import ConflictError, LimitError, NotFoundError, StateError
from roel_service.store.builds import BuiltVersion
from roel_service.store.records import VersionState

from .samples import finalized, leased

BUILT = BuiltVersion(
    rlm_bytes=b"map file", line_count=4, bounds_m=[0.0, 0, 0, 1, 2, 3], report={"line_count": 4}
)


@pytest.fixture
def maps(store):
    finalized(store)
    store.maps.create("house")
    return store.maps


def built(store, data=b"map file"):
    operation = store.builds.begin("house", "walk")
    version = BuiltVersion(rlm_bytes=data, line_count=4, bounds_m=BUILT.bounds_m, report={})
    store.operations.succeed(leased(store, operation), version)
    return store.maps.version("house", operation.version)


def test_a_map_is_found_by_its_id(maps):
    assert maps.get("house").version_count == 0
    with pytest.raises(NotFoundError, match="elsewhere"):
        maps.get("elsewhere")


def test_an_id_in_use_is_refused(maps):
    with pytest.raises(ConflictError) as caught:
        maps.create("house")
    assert caught.value.reason == "ALREADY_EXISTS"


def test_versions_are_numbered_and_latest_is_the_newest_active_one(store, maps):
    built(store)
    built(store)
    store.operations.cancel(store.builds.begin("house", "walk").id)
    assert maps.get("house").version_count == 3
    assert maps.version("house", "latest").version == 2
    assert [item.version for item in maps.version_page("house", 0, 10)] == [1, 2, 3]
    assert [item.version for item in maps.version_page("house", 1, 1)] == [2]


def test_a_map_without_an_active_version_has_no_latest(store, maps):
    store.builds.begin("house", "walk")
    with pytest.raises(NotFoundError, match="house latest"):
        maps.version("house", "latest")


def test_a_version_that_never_was_is_not_found(maps):
    with pytest.raises(NotFoundError, match="house v7"):
        maps.version("house", 7)
    with pytest.raises(NotFoundError, match="elsewhere"):
        maps.version_page("elsewhere", 0, 10)


def test_the_file_of_an_active_version_is_what_was_built(store, maps):
    assert maps.map_file(built(store, b"bytes")) == b"bytes"


def test_a_version_at_work_has_no_file(store, maps):
    operation = store.builds.begin("house", "walk")
    with pytest.raises(StateError) as caught:
        maps.map_file(maps.version("house", operation.version))
    assert caught.value.reason == "MAP_NOT_ACTIVE"


def test_a_purged_map_takes_its_versions_operations_and_files_along(store, maps, folder):
    record = built(store, b"only here")
    maps.purge("house", "", None)
    with pytest.raises(NotFoundError):
        maps.get("house")
    with pytest.raises(NotFoundError):
        maps.version("house", 1)
    with pytest.raises(NotFoundError):
        store.operations.get(record.operation_id)
    store.collect_garbage(unused_for_s=-1.0)
    assert not list((folder / "blobs").rglob(record.sha256))


def test_a_map_at_work_cannot_be_deleted(store, maps):
    store.builds.begin("house", "walk")
    with pytest.raises(StateError) as caught:
        maps.delete("house", "", None)
    assert caught.value.reason == "MAP_IN_USE"
    with pytest.raises(StateError):
        maps.purge("house", "", None)
    with pytest.raises(StateError) as version_in_use:
        maps.delete_version("house", 1, None)
    assert version_in_use.value.reason == "MAP_IN_USE"


def test_pages_follow_the_order_of_ids(store, maps):
    for map_id in ("garden", "attic"):
        maps.create(map_id)
    assert [item.id for item in maps.page("", 2)] == ["attic", "garden"]
    assert [item.id for item in maps.page("garden", 2)] == ["house"]


def test_version_records_round_trip(store, maps):
    record = built(store)
    assert record.state is VersionState.ACTIVE
    assert record.bounds_m == BUILT.bounds_m
    assert record.size_bytes == len(b"map file")


def test_a_deleted_map_is_hidden_and_refused_until_it_is_undeleted(store, maps):
    built(store)
    deleted = maps.delete("house", "", None)
    assert deleted.purge_time_us > deleted.delete_time_us > 0
    assert maps.get("house") == deleted
    assert maps.page("", 10) == []
    assert maps.page("", 10, show_deleted=True) == [deleted]
    for use in (
        lambda: maps.delete("house", "", None),
        lambda: maps.update("house", {"display_name": "x"}, "", None),
        lambda: maps.version("house", 1),
        lambda: maps.promote("house", 1, "live", 9),
        lambda: store.builds.begin("house", "walk"),
    ):
        with pytest.raises(StateError) as caught:
            use()
        assert caught.value.reason == "MAP_DELETED"
    with pytest.raises(ConflictError):
        maps.create("house")
    back = maps.undelete("house", deleted.etag, None)
    assert (back.delete_time_us, back.purge_time_us) == (0, 0)
    assert maps.version("house", "latest").version == 1
    with pytest.raises(StateError) as caught:
        maps.undelete("house", "", None)
    assert caught.value.reason == "MAP_NOT_DELETED"


def test_what_was_deleted_long_ago_is_forgotten(store, maps, folder):
    maps.create("attic")
    for _ in range(2):
        built(store)
    maps.delete_version("house", 1, None)
    maps.delete("attic", "", None)
    maps.forget_deleted()
    assert maps.version("house", 1).state is VersionState.DELETED
    with closing(sqlite3.connect(folder / "rows.sqlite")) as connection, connection:
        for table in ("map", "map_version"):
            connection.execute(f"UPDATE {table} SET purge_time_us = 1 WHERE purge_time_us > 0")
    maps.forget_deleted()
    assert [item.id for item in maps.page("", 10, show_deleted=True)] == ["house"]
    assert [item.version for item in maps.version_page("house", 0, 10)] == [2]


def test_an_alias_names_one_version_and_can_go_back(store, maps):
    for _ in range(2):
        built(store)
    assert maps.promote("house", 2, "live", 9).aliases == {"live": 2, "latest": 2}
    assert maps.promote("house", 1, "live", 9).aliases == {"live": 1, "latest": 2}
    assert maps.promote("house", "live", "canary", 9).aliases["canary"] == 1
    assert maps.version("house", "live").version == 1
    assert maps.page("", 10) == [maps.get("house")]
    with pytest.raises(LimitError) as caught:
        maps.promote("house", 2, "third", 2)
    assert caught.value.reason == "TOO_MANY_ALIASES"
    with pytest.raises(NotFoundError, match="house nobody"):
        maps.version("house", "nobody")


def test_only_an_active_version_is_promoted(store, maps):
    operation = store.builds.begin("house", "walk")
    with pytest.raises(StateError) as caught:
        maps.promote("house", operation.version, "live", 9)
    assert caught.value.reason == "MAP_NOT_ACTIVE"


def test_a_deleted_version_cannot_be_used_and_is_never_latest(store, maps):
    first, second = built(store), built(store)
    maps.promote("house", 1, "live", 9)
    with pytest.raises(StateError) as has_alias:
        maps.delete_version("house", 1, None)
    assert has_alias.value.reason == "VERSION_HAS_ALIAS"
    deleted = maps.delete_version("house", second.version, None)
    assert maps.get("house").aliases == {"live": 1, "latest": first.version}
    for use in (
        lambda: maps.map_file(deleted),
        lambda: maps.promote("house", 2, "live", 9),
        lambda: maps.delete_version("house", 2, None),
    ):
        with pytest.raises(StateError) as caught:
            use()
        assert caught.value.reason == "MAP_NOT_ACTIVE"


def test_a_change_needs_the_current_etag_if_it_names_one(maps):
    first = maps.get("house")
    second = maps.update("house", {"labels": {"floor": "2"}}, first.etag, None)
    assert second.labels == {"floor": "2"}
    assert second.etag != first.etag
    for change in (
        lambda: maps.update("house", {}, first.etag, None),
        lambda: maps.delete("house", first.etag, None),
        lambda: maps.purge("house", first.etag, None),
        lambda: maps.promote("house", 1, "live", 9, etag=first.etag),
    ):
        with pytest.raises(ConflictError) as caught:
            change()
        assert caught.value.reason == "ETAG_MISMATCH"
    deleted = maps.delete("house", second.etag, None)
    with pytest.raises(ConflictError):
        maps.undelete("house", second.etag, None)
    assert maps.get("house") == deleted


def test_an_etag_is_not_taken_for_that_of_an_earlier_map_of_the_id(maps):
    first = maps.get("house")
    maps.purge("house", "", None)
    assert maps.create("house").etag != first.etag
