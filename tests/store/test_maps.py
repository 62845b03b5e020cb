import pytest

from roel_service.errors import ConflictError, NotFoundError, StateError
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
    assert maps.version("house", None).version == 2
    assert [item.version for item in maps.version_page("house", 0, 10)] == [1, 2, 3]
    assert [item.version for item in maps.version_page("house", 1, 1)] == [2]


def test_a_map_without_an_active_version_has_no_latest(store, maps):
    store.builds.begin("house", "walk")
    with pytest.raises(NotFoundError, match="an active version of house"):
        maps.version("house", None)


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


def test_a_deleted_map_takes_its_versions_operations_and_blobs_along(store, maps, folder):
    record = built(store, b"only here")
    maps.delete("house")
    with pytest.raises(NotFoundError):
        maps.get("house")
    with pytest.raises(NotFoundError):
        maps.version("house", 1)
    with pytest.raises(NotFoundError):
        store.operations.get(record.operation_id)
    assert not list((folder / "blobs").rglob(record.sha256))


def test_a_map_at_work_cannot_be_deleted(store, maps):
    store.builds.begin("house", "walk")
    with pytest.raises(StateError) as caught:
        maps.delete("house")
    assert caught.value.reason == "MAP_IN_USE"


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
