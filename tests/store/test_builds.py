import pytest

from roel_service.errors import NotFoundError, StateError
from roel_service.progress import Progress
from roel_service.store.builds import BuiltVersion
from roel_service.store.records import OperationState, VersionState

from .samples import CAMERA, LIMIT_BYTES, chunk, finalized

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
    assert builds.get(operation.id) == operation
    version = store.maps.version("house", operation.version)
    assert version.state is VersionState.CREATING
    assert version.operation_id == operation.id


def test_progress_is_recorded_and_counted(builds):
    operation = builds.begin("house", "walk")
    progress = Progress(stage="refine", done_count=2, total_count=8, fraction=0.75)
    record = builds.advance(operation.id, progress)
    assert record.state is OperationState.RUNNING
    assert (record.stage, record.done_count, record.total_count) == ("refine", 2, 8)
    assert record.fraction == 0.75
    assert record.update_seq == operation.update_seq + 1
    assert builds.get(operation.id) == record


def test_success_makes_the_version_active(store, builds):
    operation = builds.begin("house", "walk")
    record = builds.succeed(operation.id, BUILT)
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
    record = getattr(builds, end)(operation.id, *arguments)
    assert record.state is state
    assert record.error == b"".join(arguments)
    assert store.maps.version("house", 1).state is VersionState.FAILED


def test_the_first_end_is_the_last(store, builds):
    operation = builds.begin("house", "walk")
    ended = builds.cancel(operation.id)
    late = Progress(stage="trim", done_count=0, total_count=0, fraction=0.9)
    assert builds.succeed(operation.id, BUILT) == ended
    assert builds.fail(operation.id, b"late") == ended
    assert builds.advance(operation.id, late) == ended
    assert store.maps.version("house", 1).state is VersionState.FAILED


def test_unfinished_builds_are_those_without_an_end(builds):
    queued, running, ended = (builds.begin("house", "walk") for _ in range(3))
    builds.advance(running.id, Progress(stage="", done_count=0, total_count=0, fraction=0.0))
    builds.cancel(ended.id)
    assert {item.id for item in builds.unfinished()} == {queued.id, running.id}


def test_pages_follow_the_order_of_ids(builds):
    ids = sorted(builds.begin("house", "walk").id for _ in range(3))
    assert [item.id for item in builds.page("", 2)] == ids[:2]
    assert [item.id for item in builds.page(ids[1], 2)] == ids[2:]


def test_only_an_operation_that_has_ended_can_be_deleted(store, builds):
    operation = builds.begin("house", "walk")
    with pytest.raises(StateError) as caught:
        builds.delete(operation.id)
    assert caught.value.reason == "OPERATION_RUNNING"
    builds.succeed(operation.id, BUILT)
    builds.delete(operation.id)
    with pytest.raises(NotFoundError):
        builds.get(operation.id)
    assert store.maps.version("house", 1).state is VersionState.ACTIVE


def test_a_build_needs_a_map_and_a_finalized_recording_with_poses(store, builds):
    with pytest.raises(NotFoundError, match="map"):
        builds.begin("elsewhere", "walk")
    with pytest.raises(NotFoundError, match="event stream"):
        builds.begin("house", "elsewhere")
    store.event_streams.create("open", CAMERA)
    with pytest.raises(StateError) as not_finalized:
        builds.begin("house", "open")
    store.event_streams.append_chunks("open", [chunk(0)], LIMIT_BYTES)
    store.event_streams.finalize("open")
    with pytest.raises(StateError) as no_poses:
        builds.begin("house", "open")
    assert not_finalized.value.reason == "STREAM_NOT_FINALIZED"
    assert no_poses.value.reason == "NO_POSES"
    assert store.maps.get("house").version_count == 0
