"""Rows as values."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, NamedTuple

from sqlalchemy import RowMapping

from roel_service.scene.camera import Camera, CameraModel

# Columns and their values, from the database or remembered as a text.
Row = Mapping[str, Any] | RowMapping


class StreamState(Enum):
    """Life of a recording."""

    OPEN = "open"
    FINALIZED = "finalized"


class VersionState(Enum):
    """Life of a map version."""

    CREATING = "creating"
    PREVIEW = "preview"
    ACTIVE = "active"
    FAILED = "failed"
    DELETED = "deleted"

    @property
    def is_usable(self) -> bool:
        return self in USABLE


USABLE = (VersionState.PREVIEW, VersionState.ACTIVE)


class OperationMethod(Enum):
    """Methods of the service that answer with an operation, by their names there."""

    BUILD_MAP = "BuildMap"
    IMPORT_MAP = "ImportMap"
    IMPORT_EVENT_STREAM = "ImportEventStream"
    REFINE_POSES = "RefinePoses"
    BATCH_REGISTER = "BatchRegister"
    BATCH_LOCALIZE = "BatchLocalize"


class OperationState(Enum):
    """Life of an operation."""

    QUEUED = "queued"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def is_final(self) -> bool:
        return self not in UNFINISHED


UNFINISHED = (OperationState.QUEUED, OperationState.RUNNING)


@dataclass(frozen=True, kw_only=True)
class EventStreamRecord:
    """A recording without its events.

    Attributes:
        id: chosen by the client, unique among the living.
        uid: chosen by the server, never used again; names the append file.
        start_us, end_us: first and last event on the clock of the poses; 0 without events.
        digest: hexadecimal SHA-256 of all chunks in order; empty until finalized.
        fence: number of the writer that may append; grows with every takeover.
        longest_gap_us: longest time between two neighbouring events.
        owner: on whose behalf it was made.
    """

    id: str
    uid: str
    state: StreamState
    camera: Camera
    chunk_count: int
    event_count: int
    size_bytes: int
    start_us: int
    end_us: int
    pose_count: int
    digest: str
    fence: int
    longest_gap_us: int
    create_time_us: int
    owner: str = ""
    labels: dict[str, str] = field(default_factory=dict)

    @property
    def etag(self) -> str:
        return f"{self.uid[:8]}-{self.chunk_count}-{self.pose_count}-{self.state.value}"


class MapRecord(NamedTuple):
    """A named map; its versions are 1 to `version_count`.

    A tuple, because a page of them is made for one call, and a frozen dataclass takes ten times as
    long to make.

    Attributes:
        uid: chosen by the server, never used again.
        revision: grows with every change that a caller makes.
        delete_time_us, purge_time_us: when it was deleted and will be forgotten; 0 while it lives.
        aliases: number of the version that each one names, with `latest`, the newest usable one.
    """

    id: str
    uid: str
    version_count: int
    display_name: str
    revision: int
    create_time_us: int
    update_time_us: int
    delete_time_us: int
    purge_time_us: int
    labels: dict[str, str]
    aliases: dict[str, int]

    @property
    def etag(self) -> str:
        return f"{self.uid[:8]}-{self.revision}"

    @property
    def is_deleted(self) -> bool:
        return self.delete_time_us != 0


@dataclass(frozen=True, kw_only=True)
class MapVersionRecord:
    """One version; all from `sha256` to `report` are empty until it is usable.

    Attributes:
        sha256, size_bytes: of the map file.
        bounds_m: lower corner, then upper corner, 6 numbers.
        report: of the build, as the command line prints it; empty if it was imported.
        imported_file: what it was read from; empty if it was built.
        provenance: what the map was made of.
        purge_time_us: when a deleted version will be forgotten; 0 for any other.
        trajectory_sha256, trajectory_bytes: its poses, if they were refined with its lines.
        deleted_state: in which state it was deleted; empty for any other.
    """

    map_id: str
    version: int
    state: VersionState
    event_stream_id: str
    operation_id: str
    sha256: str
    size_bytes: int
    line_count: int
    bounds_m: list[float]
    report: dict[str, Any]
    create_time_us: int
    imported_file: dict[str, Any] = dataclasses.field(default_factory=dict)
    provenance: dict[str, str] = dataclasses.field(default_factory=dict)
    purge_time_us: int = 0
    trajectory_sha256: str = ""
    trajectory_bytes: int = 0
    deleted_state: str = ""


@dataclass(frozen=True, kw_only=True)
class OperationRecord:
    """A long-running method, from its request to its end.

    Attributes:
        request_sha256: hexadecimal digest of the request, but for its request id.
        map_id, version, event_stream_id: what it works on; empty or 0 where there is no such thing.
        metadata: what progress cannot say, as the caller of the store encoded it.
        result: the answer in the same way; empty where rows tell it.
        error: what went wrong in the same way; empty unless FAILED.
        update_seq: grows with every change.
        end_time_us, expire_time_us: 0 until it is final.
        result_sha256: file that belongs to the answer; empty if there is none.
        owner: on whose behalf it runs.
    """

    id: str
    method: OperationMethod
    request_sha256: str
    map_id: str
    version: int
    event_stream_id: str
    state: OperationState
    stage: str
    done_count: int
    total_count: int
    fraction: float
    metadata: bytes
    result: bytes
    error: bytes
    update_seq: int
    create_time_us: int
    end_time_us: int
    expire_time_us: int
    result_sha256: str = ""
    owner: str = ""


class TaskState(Enum):
    """Life of a task; DONE and FAILED are its ends."""

    READY = "ready"
    LEASED = "leased"
    DONE = "done"
    FAILED = "failed"


@dataclass(frozen=True, kw_only=True)
class Lease:
    """The right to end an attempt; void as soon as a task has another fence."""

    task_id: str
    operation_id: str
    fence: int


@dataclass(frozen=True, kw_only=True)
class TaskRecord:
    """The work of an operation.

    Attributes:
        parameters: what the work needs to know, as the caller of the store encoded it.
        inputs: digests of blobs that must stay until the task has ended.
        attempt_count: attempts begun.
        memory_doublings: how often its memory limit was doubled, because it was too small.
        failure_hash: fingerprint of the last failure that may pass; empty if there was none.
        not_before_us: when it may be leased.
        lease_owner, lease_until_us: who works on it, and until when that is believed.
        fence: grows with every lease.
    """

    id: str
    operation_id: str
    state: TaskState
    parameters: bytes
    inputs: list[str]
    attempt_count: int
    memory_doublings: int
    failure_hash: str
    not_before_us: int
    lease_owner: str
    lease_until_us: int
    fence: int

    @property
    def lease(self) -> Lease:
        return Lease(task_id=self.id, operation_id=self.operation_id, fence=self.fence)


@dataclass(frozen=True, kw_only=True)
class BlobRecord:
    """A blob that is kept because it may be needed; its owner uploaded it first."""

    sha256: str
    size_bytes: int
    create_time_us: int
    last_used_us: int
    owner: str = ""


@dataclass(frozen=True, kw_only=True)
class UploadRecord:
    """A blob on its way.

    Attributes:
        id: chosen by the client.
        sha256, size_bytes: what it is to become.
        committed_bytes: what is durable of it.
        fence: number of the writer that may append; grows with every takeover.
        owner: on whose behalf it was begun.
    """

    id: str
    sha256: str
    size_bytes: int
    committed_bytes: int
    fence: int
    expire_time_us: int
    owner: str = ""


def now_us() -> int:
    """Microseconds since 1970 (UTC)."""
    return time.time_ns() // 1000


def row_from_record(record: Any) -> dict[str, Any]:
    """Columns and values of one record."""
    return stored({item.name: getattr(record, item.name) for item in dataclasses.fields(record)})


def stored(values: dict[str, Any]) -> dict[str, Any]:
    """The values in the form of their columns."""
    return {name: _stored(value) for name, value in values.items()}


def event_stream_from_row(row: Row) -> EventStreamRecord:
    """The inverse of `row_from_record`."""
    parsed = {
        "state": StreamState(row["state"]),
        "camera": _camera_from_json(row["camera"]),
        # What was remembered of a request before recordings had labels says nothing of them.
        "labels": json.loads(row.get("labels", "{}")),
    }
    return EventStreamRecord(**{**row, **parsed})


def map_version_from_row(row: Row) -> MapVersionRecord:
    """The inverse of `row_from_record`."""
    texts = ("bounds_m", "report", "imported_file", "provenance")
    parsed = {name: json.loads(row[name]) for name in texts}
    return MapVersionRecord(**{**row, **parsed, "state": VersionState(row["state"])})


def operation_from_row(row: Row) -> OperationRecord:
    """The inverse of `row_from_record`."""
    states = {"state": OperationState(row["state"]), "method": OperationMethod(row["method"])}
    return OperationRecord(**{**row, **states})


def task_from_row(row: RowMapping) -> TaskRecord:
    """The inverse of `row_from_record`."""
    parsed = {"state": TaskState(row["state"]), "inputs": json.loads(row["inputs"])}
    return TaskRecord(**{**row, **parsed})


def _stored(value: Any) -> Any:
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, Camera):
        return json.dumps({**dataclasses.asdict(value), "model": value.model.value})
    if isinstance(value, list | dict):
        return json.dumps(value)
    return value


def _camera_from_json(text: str) -> Camera:
    values = json.loads(text)
    model = CameraModel(values.pop("model"))
    distortion = tuple(values.pop("distortion"))
    return Camera(**values, model=model, distortion=distortion)
