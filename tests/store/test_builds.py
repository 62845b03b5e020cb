import pytest

from roel_service.errors import NotFoundError, StateError
from roel_service.store.builds import BuiltVersion
from roel_service.store.records import OperationState, VersionState

from .samples import CAMERA, append, chunk, finalized, leased

BUILT = BuiltVersion(
    rlm_bytes=b"map", line_count=3, bounds_m=[0.0] * 6, report={"seconds": {"trim": 0.5}}
)


@pytest.fixture
def builds(store):
    finalized(store)
    store.maps.create("house")
    return store.builds


def test_a_build_begins_queued_with_a_version_at_work(store, builds):
    operation = builds.begin("house", "walk")
    assert operation.state is OperationState.QUEUED
    assert store.operations.get(operation.id) == operation
    version = store.maps.version("house", operation.version)
    assert version.state is VersionState.CREATING
    assert version.operation_id == operation.id


def test_success_makes_the_version_active(store, builds):
    operation = builds.begin("house", "walk")
    record = store.operations.succeed(leased(store, operation), BUILT)
    assert (record.state, record.fraction) == (OperationState.SUCCEEDED, 1.0)
    assert record.end_time_us >= record.create_time_us
    version = store.maps.version("house", operation.version)
    assert version.state is VersionState.ACTIVE
    assert (version.line_count, version.report) == (3, BUILT.report)
    assert store.maps.map_file(version) == b"map"


@pytest.mark.parametrize(
    ("end", "state"), [("fail", OperationState.FAILED), ("cancel", OperationState.CANCELLED)]
)
def test_any_other_end_fails_the_version(store, builds, end, state):
    operation = builds.begin("house", "walk")
    arguments = [b"why"] if end == "fail" else []
    subject = leased(store, operation) if end == "fail" else operation.id
    record = getattr(store.operations, end)(subject, *arguments)
    assert record.state is state
    assert record.error == b"".join(arguments)
    assert store.maps.version("house", 1).state is VersionState.FAILED


def test_a_build_needs_a_map_and_a_finalized_recording_with_poses(store, builds):
    with pytest.raises(NotFoundError, match="map"):
        builds.begin("elsewhere", "walk")
    with pytest.raises(NotFoundError, match="event stream"):
        builds.begin("house", "elsewhere")
    store.event_streams.create("open", CAMERA)
    with pytest.raises(StateError) as not_finalized:
        builds.begin("house", "open")
    append(store.event_streams, "open", chunk(0))
    store.event_streams.finalize("open")
    with pytest.raises(StateError) as no_poses:
        builds.begin("house", "open")
    assert not_finalized.value.reason == "STREAM_NOT_FINALIZED"
    assert no_poses.value.reason == "NO_POSES"
    assert store.maps.get("house").version_count == 0
