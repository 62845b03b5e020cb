"""Every reason an error can have: the one table behind statuses, `docs/errors.md` and its tests.

Whoever raises a new reason adds its row here, runs `python docs/generate.py`, and writes the test
that raises it.
"""

from __future__ import annotations

from types import MappingProxyType
from typing import NamedTuple

from roel_service.errors import (
    CameraError,
    CloudError,
    ConfigError,
    ConflictError,
    CorruptionError,
    DeadlineError,
    EventsError,
    InputError,
    LimitError,
    MapFileError,
    MeshError,
    NoAnswerError,
    NotFoundError,
    PanoramaError,
    PermissionDeniedError,
    RoelError,
    StateError,
    TrajectoryError,
    UnauthenticatedError,
    UnavailableError,
    UnimplementedError,
)


class Reason(NamedTuple):
    """One row.

    Attributes:
        name: as in `RoelError.reason` and `ErrorInfo.reason`; never changes its meaning.
        kind: the class that is raised with it, which decides the gRPC code.
        when: what happened, for the documentation.
        retry_after_s: told as `RetryInfo`: the same call may succeed after this long. None where
            waiting does not help.
    """

    name: str
    kind: type[RoelError]
    when: str
    retry_after_s: float | None = None


_ROWS = (
    Reason(
        "INPUT_INVALID",
        InputError,
        "an input or option that cannot be used, for no reason listed below",
    ),
    Reason("EVENTS_INVALID", EventsError, "an event file that cannot be read"),
    Reason("NO_EVENTS", EventsError, "a recording without events"),
    Reason("EVENT_TIME_NOT_MONOTONE", EventsError, "an event that is older than the one before it"),
    Reason("EVENT_OUT_OF_BOUNDS", EventsError, "an event outside the sensor"),
    Reason("EVENT_POLARITY_INVALID", EventsError, "a polarity that is none"),
    Reason("SENSOR_MISMATCH", EventsError, "events of a sensor that is not the camera's"),
    Reason("CHUNK_MALFORMED", EventsError, "bytes that are no event chunk"),
    Reason("CHUNK_CRC_MISMATCH", EventsError, "an event chunk that was damaged on its way"),
    Reason(
        "UNSUPPORTED_ENCODING",
        EventsError,
        "an event chunk of a version or encoding that this release does not know",
    ),
    Reason(
        "UNSUPPORTED_HDF5_FILTER",
        EventsError,
        "an event file whose compression this program does not know",
    ),
    Reason("POSES_INVALID", TrajectoryError, "poses that are no trajectory"),
    Reason(
        "POSE_COVERAGE_INSUFFICIENT", TrajectoryError, "poses that do not cover the time asked for"
    ),
    Reason("CAMERA_INVALID", CameraError, "a calibration that cannot be"),
    Reason(
        "CONFIG_INVALID",
        ConfigError,
        "an unknown table, key or preset, or a value of a wrong type or range",
    ),
    Reason("CLOUD_INVALID", CloudError, "a point cloud that cannot be used"),
    Reason("CLOUD_UNIT", CloudError, "a point cloud in another unit than the map"),
    Reason("MESH_INVALID", MeshError, "a mesh that cannot be used"),
    Reason(
        "PANORAMA_INVALID",
        PanoramaError,
        "an image that is no panorama, or no photograph of its camera",
    ),
    Reason("MAP_FILE_INVALID", MapFileError, "a map file that is damaged or of an unknown format"),
    Reason("ID_INVALID", InputError, "an id that cannot name a resource"),
    Reason("NAME_INVALID", InputError, "a text that is no resource name"),
    Reason("REQUEST_ID_INVALID", InputError, "a request id that is no UUID of version 4"),
    Reason("REQUEST_ID_REUSED", InputError, "a request id that named another request before"),
    Reason("PAGE_SIZE_INVALID", InputError, "a negative page size"),
    Reason("PAGE_TOKEN_INVALID", InputError, "a page token that does not belong to this list"),
    Reason(
        "UPLOAD_ORDER", InputError, "an upload that does not begin with the name of its recording"
    ),
    Reason("PART_CRC_MISMATCH", InputError, "a part of a blob that was damaged on its way"),
    Reason("PART_INVALID", InputError, "a part that no blob of the declared size has"),
    Reason(
        "INSECURE_HOST",
        InputError,
        "serving another host than loopback without encryption or `--insecure`",
    ),
    Reason("TLS_INVALID", InputError, "files that are no certificate and its key"),
    Reason("MANIFEST_INVALID", InputError, "a manifest of a batch that is no file of requests"),
    Reason("NO_ANSWER", NoAnswerError, "sound inputs with no answer in them"),
    Reason("DATA_UNSOUND", NoAnswerError, "a data folder in which a check found problems"),
    Reason(
        "TOO_FEW_LINES",
        NoAnswerError,
        "a map of fewer than three lines, or too few lines in view to hold poses",
    ),
    Reason("NOT_REGISTERED", NoAnswerError, "a registration not to be relied on, with `--strict`"),
    Reason("NOT_TRACKED", NoAnswerError, "a recording with hardly a pose to be relied on"),
    Reason("NOT_LOCATED", NoAnswerError, "a panorama without a pose to rely on, with `--strict`"),
    Reason("NOT_FOUND", NotFoundError, "a resource that does not exist"),
    Reason(
        "WRONG_STATE",
        StateError,
        "a resource in another state than the request needs, for no reason listed below",
    ),
    Reason("STREAM_FINALIZED", StateError, "an upload to a recording that is frozen"),
    Reason("STREAM_NOT_EMPTY", StateError, "an import into a recording that has events"),
    Reason("STREAM_NOT_FINALIZED", StateError, "a build from a recording that is still open"),
    Reason("NO_POSES", StateError, "a build from a recording without poses"),
    Reason("SEQUENCE_GAP", StateError, "a chunk or part that is not the next one"),
    Reason("STREAM_IN_USE", StateError, "deleting a recording that a build reads"),
    Reason("MAP_IN_USE", StateError, "deleting a map or a version that is being made"),
    Reason("MAP_NOT_ACTIVE", StateError, "a version that is not complete, or deleted"),
    Reason("MAP_DELETED", StateError, "using a map that is deleted; UndeleteMap takes that back"),
    Reason("MAP_NOT_DELETED", StateError, "undeleting a map that is not deleted"),
    Reason("VERSION_HAS_ALIAS", StateError, "deleting a version that an alias names"),
    Reason("OPERATION_RUNNING", StateError, "deleting an operation that has not ended"),
    Reason("DATA_IN_USE", StateError, "a data folder that another server has open"),
    Reason("DATA_TOO_NEW", StateError, "a data folder that a newer release wrote"),
    Reason(
        "DATA_TOO_OLD", StateError, "a data folder of an older release, not started with this one"
    ),
    Reason("BACKUP_OUTDATED", StateError, "a data folder whose copy is not sound, time after time"),
    Reason("CONFLICT", ConflictError, "somebody else was faster, for no reason listed below"),
    Reason("ALREADY_EXISTS", ConflictError, "creating what exists"),
    Reason("ETAG_MISMATCH", ConflictError, "changing what was changed since it was read"),
    Reason(
        "CHUNK_CONFLICT", ConflictError, "a chunk or part that was stored before with other bytes"
    ),
    Reason("WRITER_REPLACED", ConflictError, "an upload that another one took over"),
    Reason("LIMIT_EXCEEDED", LimitError, "something too large, for no reason listed below"),
    Reason("RECORDING_TOO_LONG", LimitError, "more poses than are refined at once"),
    Reason("MESSAGE_TOO_LARGE", LimitError, "a message beyond the limit of either side"),
    Reason("EVENT_STREAM_TOO_LARGE", LimitError, "a recording beyond the server's limit"),
    Reason("CREDIT_EXCEEDED", LimitError, "an upload that does not wait for acknowledgements"),
    Reason(
        "TOO_MANY_UPLOADS",
        LimitError,
        "more uploads at a time than the server takes",
        retry_after_s=5.0,
    ),
    Reason("BLOB_TOO_LARGE", LimitError, "a blob, or a part of one, beyond the server's limit"),
    Reason("TOO_MANY_POSES", LimitError, "more poses than the server takes"),
    Reason("TOO_MANY_ALIASES", LimitError, "more aliases of a map than the server takes"),
    Reason(
        "QUOTA_STORAGE", LimitError, "more recordings and blobs, in bytes, than the caller may have"
    ),
    Reason("QUOTA_EVENT_STREAMS", LimitError, "more recordings than the caller may have"),
    Reason(
        "QUOTA_CONCURRENT_BUILDS",
        LimitError,
        "more operations at a time than the caller may have",
        retry_after_s=5.0,
    ),
    Reason("QUEUE_FULL", LimitError, "more work than the server lets wait", retry_after_s=5.0),
    Reason("UNAVAILABLE", UnavailableError, "a server that cannot be reached"),
    Reason(
        "UPLOAD_IDLE",
        UnavailableError,
        "an upload that sent nothing for a long time; what was acknowledged stays",
    ),
    Reason("DRAINING", UnavailableError, "a server that is about to end", retry_after_s=2.0),
    Reason(
        "STORE_UNAVAILABLE",
        UnavailableError,
        "a data folder that cannot be read or written, such as one on a full disk",
        retry_after_s=5.0,
    ),
    Reason(
        "WORKER_LOST",
        UnavailableError,
        "work whose process was killed, or whose server was, in all attempts",
        retry_after_s=1.0,
    ),
    Reason(
        "METHOD_NOT_IMPLEMENTED",
        UnimplementedError,
        "a method that the protocol has and this server does not; GetCapabilities lists them",
    ),
    Reason(
        "TASK_OUT_OF_MEMORY", LimitError, "work that needs more memory than the server lets it have"
    ),
    Reason("TASK_TIME_LIMIT", LimitError, "work that takes longer than the server lets it"),
    Reason("LEASE_LOST", ConflictError, "the end of an attempt whose task somebody else took"),
    Reason(
        "DEADLINE_TOO_SHORT",
        DeadlineError,
        "a call that would wait for its turn longer than its deadline allows",
    ),
    Reason("UNAUTHENTICATED", UnauthenticatedError, "a caller that nobody knows"),
    Reason(
        "PERMISSION_DENIED",
        PermissionDeniedError,
        "a method beyond the caller's role, whether or not the resource exists",
    ),
    Reason(
        "BLOB_CORRUPT",
        CorruptionError,
        "stored or received bytes that do not match their digest",
    ),
    Reason(
        "INTERNAL",
        RoelError,
        "a fault of the program; the message names the entry in the server's log",
    ),
    Reason("POISONED", RoelError, "work that failed twice with the same fault of the program"),
)

REASONS = MappingProxyType({row.name: row for row in _ROWS})
