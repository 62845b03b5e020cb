"""Exceptions that say who broke which contract.

    RoelError
    ├── InputError          an input or option that cannot be used
    │   ├── EventsError  TrajectoryError  CameraError  CloudError
    │   └── PanoramaError  MapFileError  ConfigError  MeshError
    ├── NoAnswerError       sound inputs, no answer in them
    ├── NotFoundError       unknown resource
    ├── StateError          a resource is not in the state that the request needs
    │   └── ConflictError   somebody else was faster
    ├── LimitError          quota, full queue, too large
    ├── UnavailableError    draining, or the server cannot be reached
    ├── UnimplementedError  the protocol has the method, this server does not
    ├── DeadlineError       the caller's deadline is too short to begin
    ├── UnauthenticatedError  PermissionDeniedError   who calls is not known, or may not
    └── CorruptionError     stored bytes do not match their digest
    Cancelled               raised through a progress callback; not a fault

An expected failure (one track, one panorama) is a status in the result, never an exception.
Anything else that escapes is a bug.
"""

from __future__ import annotations

from typing import Any, ClassVar


class RoelError(Exception):
    """A broken contract, told in one line as `subject: expected ..., found ...`.

    Attributes:
        reason: machine-readable name, stable across releases; a row of `roel_service.reasons`.
        subject: the file, option or resource the message is about.
        expected: what was expected there.
        found: what was found instead.
        retry_after_s: the server's word that the same call may succeed after this long, else None.
    """

    default_reason: ClassVar[str] = "INTERNAL"
    retry_after_s: float | None = None

    def __init__(
        self, subject: str, expected: str, found: str, *, reason: str | None = None
    ) -> None:
        super().__init__(subject, expected, found)
        self.subject = subject
        self.expected = expected
        self.found = found
        self.reason = reason or self.default_reason

    def __reduce__(self) -> tuple[object, ...]:
        # Errors cross process borders; what is keyword-only would be lost.
        return (type(self), self.args, dict(vars(self)))

    def __str__(self) -> str:
        return " ".join(f"{self.subject}: expected {self.expected}, found {self.found}".split())


class InputError(RoelError):
    """An input or option that cannot be used."""

    default_reason = "INPUT_INVALID"


class EventsError(InputError):
    """Events that no sensor could have sent; see the reasons in `docs/errors.md`."""

    default_reason = "EVENTS_INVALID"


class TrajectoryError(InputError):
    """Poses that are no trajectory, or that do not cover the time asked for."""

    default_reason = "POSES_INVALID"


class CameraError(InputError):
    """A calibration that is incomplete or impossible."""

    default_reason = "CAMERA_INVALID"


class CloudError(InputError):
    """A point cloud that cannot be used."""

    default_reason = "CLOUD_INVALID"


class MeshError(InputError):
    """A triangle mesh that cannot be used."""

    default_reason = "MESH_INVALID"


class PanoramaError(InputError):
    """An image that is no equirectangular panorama."""

    default_reason = "PANORAMA_INVALID"


class MapFileError(InputError):
    """A line map file that is damaged or of an unknown format."""

    default_reason = "MAP_FILE_INVALID"


class ConfigError(InputError):
    """A configuration key or value outside what its stage accepts."""

    default_reason = "CONFIG_INVALID"


class NoAnswerError(RoelError):
    """Sound inputs with no answer in them.

    Attributes:
        result: what there is to tell all the same, such as the report of a build; None if nothing.
    """

    default_reason = "NO_ANSWER"
    result: dict[str, Any] | None = None

    def __init__(
        self,
        subject: str,
        expected: str,
        found: str,
        *,
        reason: str | None = None,
        result: dict[str, Any] | None = None,
    ) -> None:
        super().__init__(subject, expected, found, reason=reason)
        self.result = result


class NotFoundError(RoelError):
    """A resource that does not exist."""

    default_reason = "NOT_FOUND"


class StateError(RoelError):
    """A resource that is not in the state the request needs."""

    default_reason = "WRONG_STATE"


class ConflictError(StateError):
    """Somebody else changed the resource first."""

    default_reason = "CONFLICT"


class LimitError(RoelError):
    """A quota is used up, a queue is full, or something is too large."""

    default_reason = "LIMIT_EXCEEDED"


class UnavailableError(RoelError):
    """The server is draining or cannot be reached."""

    default_reason = "UNAVAILABLE"


class UnimplementedError(RoelError):
    """The protocol has the method, this server does not."""

    default_reason = "METHOD_NOT_IMPLEMENTED"


class DeadlineError(RoelError):
    """The caller's deadline is too short for the work to begin."""

    default_reason = "DEADLINE_TOO_SHORT"


class UnauthenticatedError(RoelError):
    """Nobody knows who calls."""

    default_reason = "UNAUTHENTICATED"


class PermissionDeniedError(RoelError):
    """The caller may not do this; nothing is said about what the request names."""

    default_reason = "PERMISSION_DENIED"


class CorruptionError(RoelError):
    """Stored bytes do not match their digest."""

    default_reason = "BLOB_CORRUPT"


class Cancelled(Exception):  # noqa: N818 - the name of the event, not of a fault
    """The caller asked to stop; raised by a progress callback and passed on by algorithms."""
