"""Rows of a task as work for a child."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from roel_service.config.stages import Config
from roel_service.jobs.batch_inputs import BatchParameters
from roel_service.jobs.cache_place import CachePlace
from roel_service.jobs.event_imports import EventImportParameters
from roel_service.jobs.imports import ImportParameters
from roel_service.jobs.inputs import FollowParameters, sealed_parameters
from roel_service.jobs.questions import MapFile
from roel_service.jobs.refine_inputs import RefineParameters
from roel_service.store.garbage import LONGEST_UPLOAD_S
from roel_service.store.records import OperationRecord, StreamState, TaskRecord
from roel_service.store.store import CACHE, Store
from roel_service.v1 import config_pb2, maps_pb2
from roel_service.wire.configs import config_from_proto, config_to_proto
from roel_service.wire.nouns import trajectory_from_proto


class Prepared(NamedTuple):
    """Work for an executor.

    Attributes:
        extra_s: so much longer than others the work may take.
    """

    entrypoint: str
    parameters: Any
    extra_s: float = 0.0


def cache_place(store: Store, max_bytes: int) -> CachePlace | None:
    """Where results of stages and prepared inputs are kept, at most so much of them; 0 is nowhere."""
    return CachePlace(folder=store.folder / CACHE, max_bytes=max_bytes) if max_bytes else None


# Called in a thread for each attempt.
Prepare = Callable[[OperationRecord, TaskRecord], Prepared]


def build_parameters_to_bytes(config: Config) -> bytes:
    """What the row of a build's task says beside the rows that it works on."""
    return bytes(config_to_proto(config).SerializeToString(deterministic=True))


def import_preparation(store: Store) -> Prepare:
    """How an import is prepared: the version's row names the file."""

    def prepare(operation: OperationRecord, task: TaskRecord) -> Prepared:
        version = store.maps.made_version(operation)
        file = store.maps.imported_path(version)
        parameters = ImportParameters(file=file, sha256=version.imported_file["sha256"])
        return Prepared("roel_service.jobs.imports:run_import", parameters)

    return prepare


def event_import_preparation(store: Store, max_size_bytes: int) -> Prepare:
    """How an import of events is prepared: its task names the blob and the recording's fence."""

    def prepare(operation: OperationRecord, task: TaskRecord) -> Prepared:
        camera = store.event_streams.get(operation.event_stream_id).camera
        parameters = EventImportParameters(
            file=store.event_imports.blob_path(task.inputs[0]),
            width=camera.width,
            height=camera.height,
            # Attempts may overlap when a lease was lost; each has a file of its own.
            target=store.scratch_file(f"{task.id}-{task.attempt_count}.rec"),
            max_size_bytes=max_size_bytes,
            fence=int(task.parameters),
        )
        return Prepared("roel_service.jobs.event_imports:run_event_import", parameters)

    return prepare


def refinement_preparation(store: Store) -> Prepare:
    """How a refinement is prepared: its task has the request, and names the map that is fixed."""

    def prepare(operation: OperationRecord, task: TaskRecord) -> Prepared:
        request = maps_pb2.RefinePosesRequest.FromString(task.parameters)
        stream = store.event_streams.get(operation.event_stream_id)
        config = config_from_proto(request.config, "default")
        fixed = store.refinements.fixed_map(task)
        parameters = RefineParameters(
            recording=sealed_parameters(store.event_streams, stream, config, None),
            trajectory=(
                trajectory_from_proto(request.trajectory)
                if request.HasField("trajectory")
                else None
            ),
            fixed_map=fixed and MapFile(name=request.map_version, sha256=fixed[0], path=fixed[1]),
            makes_version=bool(operation.map_id),
            estimate_time_offset=request.estimate_time_offset,
            estimate_intrinsics=request.estimate_intrinsics,
        )
        return Prepared("roel_service.jobs.refinement:run_refinement", parameters)

    return prepare


def batch_preparation(
    store: Store,
    entrypoint: str,
    *,
    cache_bytes: int,
    inline_point_count: int,
    max_item_bytes: int,
    item_time_s: float,
) -> Prepare:
    """How a batch is prepared: its task names the manifest, and how many requests that has.

    Args:
        max_item_bytes: of one request.
        item_time_s: what one request may add to the time of the work.
    """

    def prepare(operation: OperationRecord, task: TaskRecord) -> Prepared:
        item_count = int(task.parameters)
        parameters = BatchParameters(
            folder=store.folder,
            manifest=store.batches.blob_path(task.inputs[0]),
            item_count=item_count,
            max_item_bytes=max_item_bytes,
            journal=store.batches.journal(task),
            earlier_journals=store.batches.earlier_journals(task),
            cache=cache_place(store, cache_bytes),
            inline_point_count=inline_point_count,
        )
        return Prepared(entrypoint, parameters, extra_s=item_count * item_time_s)

    return prepare


def build_preparation(
    store: Store, entrypoint: str, *, cache_bytes: int, patience_s: float
) -> Prepare:
    """How a build is prepared: its recording cannot be deleted meanwhile.

    Args:
        cache_bytes: kept of the results of stages; 0 keeps nothing.
        patience_s: an upload that is followed may stand still for so long.
    """
    cache = cache_place(store, cache_bytes)

    def prepare(operation: OperationRecord, task: TaskRecord) -> Prepared:
        stream = store.event_streams.get(operation.event_stream_id)
        message = config_pb2.MappingConfig.FromString(task.parameters)
        config = config_from_proto(message, "default")
        if stream.state is StreamState.FINALIZED:
            sealed = sealed_parameters(store.event_streams, stream, config, cache)
            return Prepared(entrypoint, sealed)
        followed = FollowParameters(
            folder=store.folder,
            stream_id=stream.id,
            config=config,
            patience_s=patience_s,
            cache=cache,
        )
        return Prepared(entrypoint, followed, extra_s=LONGEST_UPLOAD_S)

    return prepare
