"""Rows of the store as messages."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
from google.longrunning import operations_pb2
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp
from google.rpc import status_pb2

from roel_service.errors import Cancelled
from roel_service.store.records import (
    EventStreamRecord,
    MapRecord,
    MapVersionRecord,
    OperationMethod,
    OperationRecord,
    OperationState,
    StreamState,
    VersionState,
)
from roel_service.v1 import (
    events_pb2,
    localization_pb2,
    map_file_pb2,
    maps_pb2,
    registration_pb2,
    types_pb2,
)
from roel_service.v1 import operations_pb2 as roel_operations_pb2
from roel_service.wire import names
from roel_service.wire.errors import status_from_error
from roel_service.wire.nouns import bounds_to_proto, camera_to_proto
from roel_service.wire.results import report_to_proto

_STREAM_STATES = {
    StreamState.OPEN: events_pb2.EventStream.STATE_OPEN,
    StreamState.FINALIZED: events_pb2.EventStream.STATE_FINALIZED,
}

_VERSION_STATES = {
    VersionState.CREATING: maps_pb2.MapVersion.STATE_CREATING,
    VersionState.PREVIEW: maps_pb2.MapVersion.STATE_PREVIEW,
    VersionState.ACTIVE: maps_pb2.MapVersion.STATE_ACTIVE,
    VersionState.FAILED: maps_pb2.MapVersion.STATE_FAILED,
    VersionState.DELETED: maps_pb2.MapVersion.STATE_DELETED,
}


def event_stream_to_proto(record: EventStreamRecord) -> events_pb2.EventStream:
    """A recording."""
    return events_pb2.EventStream(
        name=names.event_stream_name(record.id),
        state=_STREAM_STATES[record.state],
        camera=camera_to_proto(record.camera),
        chunk_count=record.chunk_count,
        event_count=record.event_count,
        size_bytes=record.size_bytes,
        start_us=record.start_us,
        end_us=record.end_us,
        pose_count=record.pose_count,
        digest=record.digest,
        etag=record.etag,
        create_time=_timestamp(record.create_time_us),
        uid=record.uid,
        labels=record.labels,
    )


def map_to_proto(record: MapRecord) -> maps_pb2.Map:
    """A map."""
    message = maps_pb2.Map()
    write_map(message, record)
    return message


def write_map(message: maps_pb2.Map, record: MapRecord) -> None:
    """Make an empty message a map.

    Field by field: messages made to be copied into another take twice as long.
    """
    message.name = names.map_name(record.id)
    message.uid = record.uid
    message.version_count = record.version_count
    message.display_name = record.display_name
    message.etag = record.etag
    _write_time(message.create_time, record.create_time_us)
    _write_time(message.update_time, record.update_time_us)
    for key, value in record.labels.items():
        message.labels[key] = value
    for alias, version in record.aliases.items():
        message.aliases[alias] = f"v{version}"
    if record.is_deleted:
        _write_time(message.delete_time, record.delete_time_us)
        _write_time(message.purge_time, record.purge_time_us)


def map_version_to_proto(record: MapVersionRecord) -> maps_pb2.MapVersion:
    """A version; what only a usable one has is left out of the others."""
    message = maps_pb2.MapVersion(
        name=names.map_version_name(record.map_id, record.version),
        state=_VERSION_STATES[record.state],
        operation=names.operation_name(record.operation_id),
        create_time=_timestamp(record.create_time_us),
    )
    if record.event_stream_id:
        message.event_stream = names.event_stream_name(record.event_stream_id)
    if record.state.is_usable:
        blob = types_pb2.BlobRef(sha256=record.sha256, size_bytes=record.size_bytes)
        corners = np.array(record.bounds_m).reshape(2, 3)
        message.map.CopyFrom(blob)
        message.line_count = record.line_count
        message.bounds.CopyFrom(bounds_to_proto(corners[0], corners[1]))
        message.provenance.CopyFrom(map_file_pb2.MapProvenance(**record.provenance))
    if record.state.is_usable and record.report:
        message.report.CopyFrom(report_to_proto(record.report))
    if record.trajectory_sha256:
        poses = types_pb2.BlobRef(
            sha256=record.trajectory_sha256, size_bytes=record.trajectory_bytes
        )
        message.trajectory.CopyFrom(poses)
    if record.imported_file:
        message.imported_file.CopyFrom(_imported_file(record.imported_file))
    if record.state is VersionState.DELETED:
        message.purge_time.CopyFrom(_timestamp(record.purge_time_us))
    return message


def _imported_file(imported: dict[str, Any]) -> maps_pb2.ImportedFile:
    return maps_pb2.ImportedFile(
        blob=types_pb2.BlobRef(sha256=imported["sha256"], size_bytes=imported["size_bytes"]),
        format=imported.get("format", ""),
        dropped_line_count=imported.get("dropped_line_count", 0),
    )


BATCH_ANSWERS: dict[OperationMethod, Any] = {
    OperationMethod.BATCH_REGISTER: registration_pb2.BatchRegisterResponse,
    OperationMethod.BATCH_LOCALIZE: localization_pb2.BatchLocalizeResponse,
}


def batch_answer(record: OperationRecord) -> Any:
    """What a batch that SUCCEEDED answers with."""
    result = json.loads(record.result)
    return BATCH_ANSWERS[record.method](
        items=types_pb2.BlobRef(sha256=result["sha256"], size_bytes=result["size_bytes"]),
        item_count=result["item_count"],
        failed_count=result["failed_count"],
    )


def refinement_answer(
    record: OperationRecord, version: MapVersionRecord | None
) -> maps_pb2.RefinePosesResponse:
    """What a refinement that SUCCEEDED answers with."""
    result = json.loads(record.result)
    trajectory = types_pb2.BlobRef(sha256=result.pop("sha256"), size_bytes=result.pop("size_bytes"))
    iteration_count = result.pop("iterations")
    answer = maps_pb2.RefinePosesResponse(
        trajectory=trajectory, iteration_count=iteration_count, **result
    )
    if version is not None:
        answer.map_version.CopyFrom(map_version_to_proto(version))
    return answer


def operation_to_proto(record: OperationRecord, answer: Message | None) -> operations_pb2.Operation:
    """An operation; `answer` is that of one that SUCCEEDED."""
    operation = operations_pb2.Operation(
        name=names.operation_name(record.id), done=record.state.is_final
    )
    operation.metadata.Pack(_metadata(record))
    if record.state is OperationState.CANCELLED:
        operation.error.CopyFrom(status_from_error(Cancelled()))
    elif record.state is OperationState.FAILED:
        operation.error.CopyFrom(status_pb2.Status.FromString(record.error))
    elif answer is not None:
        operation.response.Pack(answer)
    return operation


def _metadata(record: OperationRecord) -> roel_operations_pb2.OperationMetadata:
    """What the columns say, beside what else the scheduler knows of the work."""
    metadata = roel_operations_pb2.OperationMetadata.FromString(record.metadata)
    metadata.method = record.method.value
    metadata.target = _TARGETS[record.method](record)
    for name in ("stage", "done_count", "total_count", "fraction", "update_seq"):
        setattr(metadata, name, getattr(record, name))
    metadata.create_time.CopyFrom(_timestamp(record.create_time_us))
    if record.state.is_final:
        metadata.end_time.CopyFrom(_timestamp(record.end_time_us))
        metadata.expire_time.CopyFrom(_timestamp(record.expire_time_us))
    return metadata


def _version_name(record: OperationRecord) -> str:
    return names.map_version_name(record.map_id, record.version)


def _stream_name(record: OperationRecord) -> str:
    return names.event_stream_name(record.event_stream_id)


def _refined_name(record: OperationRecord) -> str:
    return _version_name(record) if record.map_id else _stream_name(record)


def _project(record: OperationRecord) -> str:
    return names.PROJECT


# The resource that each method makes, or works for.
_TARGETS: dict[OperationMethod, Callable[[OperationRecord], str]] = {
    OperationMethod.BUILD_MAP: _version_name,
    OperationMethod.IMPORT_MAP: _version_name,
    OperationMethod.IMPORT_EVENT_STREAM: _stream_name,
    OperationMethod.REFINE_POSES: _refined_name,
    OperationMethod.BATCH_REGISTER: _project,
    OperationMethod.BATCH_LOCALIZE: _project,
}


def _timestamp(time_us: int) -> Timestamp:
    message = Timestamp()
    _write_time(message, time_us)
    return message


def _write_time(message: Timestamp, time_us: int) -> None:
    seconds, us = divmod(time_us, 1_000_000)
    message.seconds = seconds
    message.nanos = 1000 * us
