"""The exception tree as `google.rpc.Status`, and back.

A status carries one `ErrorInfo`: reason, domain, and in its metadata the class, subject, expected
and found, so that a caller far away gets the exception that was raised here.
"""

from __future__ import annotations

import json
from datetime import timedelta

from google.rpc import code_pb2, error_details_pb2, status_pb2

from roel_service import errors
from roel_service.errors import Cancelled, RoelError
from roel_service.reasons import REASONS

DOMAIN = "roel-service"
# A status travels in headers, which gRPC refuses beyond 16 KiB: six texts of this length fit even
# when every character takes four bytes and the headers' encodings add to that.
MAX_TEXT_LENGTH = 300

# How gRPC, which checks sizes before anybody sees a message, says that one is too large.
TOO_LARGE = "message larger than max"

# The first class that an error is an instance of decides; subclasses stand before their bases.
CODES: tuple[tuple[type[RoelError], int], ...] = (
    (errors.InputError, code_pb2.INVALID_ARGUMENT),
    (errors.NoAnswerError, code_pb2.FAILED_PRECONDITION),
    (errors.NotFoundError, code_pb2.NOT_FOUND),
    (errors.ConflictError, code_pb2.ABORTED),
    (errors.StateError, code_pb2.FAILED_PRECONDITION),
    (errors.LimitError, code_pb2.RESOURCE_EXHAUSTED),
    (errors.UnavailableError, code_pb2.UNAVAILABLE),
    (errors.UnimplementedError, code_pb2.UNIMPLEMENTED),
    (errors.DeadlineError, code_pb2.DEADLINE_EXCEEDED),
    (errors.UnauthenticatedError, code_pb2.UNAUTHENTICATED),
    (errors.PermissionDeniedError, code_pb2.PERMISSION_DENIED),
    (errors.CorruptionError, code_pb2.DATA_LOSS),
    (errors.RoelError, code_pb2.INTERNAL),
)

KINDS = {
    name: kind
    for name, kind in vars(errors).items()
    if isinstance(kind, type) and issubclass(kind, RoelError)
}

# What a status without our details stands for: gRPC itself answers some calls.
FALLBACK: dict[int, type[RoelError]] = {
    code_pb2.INVALID_ARGUMENT: errors.InputError,
    code_pb2.FAILED_PRECONDITION: errors.StateError,
    code_pb2.NOT_FOUND: errors.NotFoundError,
    code_pb2.ABORTED: errors.ConflictError,
    code_pb2.RESOURCE_EXHAUSTED: errors.LimitError,
    code_pb2.UNAVAILABLE: errors.UnavailableError,
    code_pb2.DEADLINE_EXCEEDED: errors.UnavailableError,
    code_pb2.UNIMPLEMENTED: errors.UnimplementedError,
    code_pb2.UNAUTHENTICATED: errors.UnauthenticatedError,
    code_pb2.PERMISSION_DENIED: errors.PermissionDeniedError,
    code_pb2.DATA_LOSS: errors.CorruptionError,
}


def status_from_error(error: RoelError | Cancelled) -> status_pb2.Status:
    """Code, one line of text, and the details that `error_from_status` restores."""
    if isinstance(error, Cancelled):
        return status_pb2.Status(code=code_pb2.CANCELLED, message="cancelled")
    info = error_details_pb2.ErrorInfo(reason=error.reason, domain=DOMAIN)
    info.metadata["error"] = type(error).__name__
    for key in ("subject", "expected", "found"):
        info.metadata[key] = getattr(error, key)[:MAX_TEXT_LENGTH]
    if isinstance(error, errors.NoAnswerError) and error.result is not None:
        info.metadata["result"] = json.dumps(error.result)
    message = str(error)[:MAX_TEXT_LENGTH]
    status = status_pb2.Status(code=code_of(type(error)), message=message)
    status.details.add().Pack(info)
    if isinstance(error, errors.InputError):
        bad = error_details_pb2.BadRequest()
        violation = bad.field_violations.add(field=info.metadata["subject"])
        violation.description = f"expected {error.expected}, found {error.found}"[:MAX_TEXT_LENGTH]
        status.details.add().Pack(bad)
    row = REASONS.get(error.reason)
    if row is not None and row.retry_after_s is not None:
        retry = error_details_pb2.RetryInfo()
        retry.retry_delay.FromTimedelta(timedelta(seconds=row.retry_after_s))
        status.details.add().Pack(retry)
    return status


def code_of(kind: type[RoelError]) -> int:
    """The gRPC code of a class of errors."""
    return next(code for listed, code in CODES if issubclass(kind, listed))


def retry_after_s(status: status_pb2.Status) -> float | None:
    """How long to wait before the same call; None where the server does not invite to it."""
    for detail in status.details:
        retry = error_details_pb2.RetryInfo()
        if detail.Unpack(retry):
            return float(retry.retry_delay.ToTimedelta().total_seconds())
    return None


def error_from_status(
    status: status_pb2.Status, *, subject: str = "server"
) -> RoelError | Cancelled:
    """The exception that a status tells of, the best guess where it has no details of ours.

    Args:
        status: from a call or an operation.
        subject: who answered, for a status without details.
    """
    if status.code == code_pb2.CANCELLED:
        return Cancelled(status.message)
    error = _restored(status, subject)
    error.retry_after_s = retry_after_s(status)
    return error


def _restored(status: status_pb2.Status, subject: str) -> RoelError:
    info = _error_info(status)
    if info is None and TOO_LARGE in status.message:
        expected, found = "messages that the other side takes", status.message
        return errors.LimitError(subject, expected, found, reason="MESSAGE_TOO_LARGE")
    if info is None:
        kind = FALLBACK.get(status.code, RoelError)
        return kind(subject, "an answer", f"{code_pb2.Code.Name(status.code)}: {status.message}")
    kind = KINDS.get(info.metadata["error"], RoelError)
    texts = (info.metadata[key] for key in ("subject", "expected", "found"))
    if kind is errors.NoAnswerError and "result" in info.metadata:
        result = json.loads(info.metadata["result"])
        return errors.NoAnswerError(*texts, reason=info.reason, result=result)
    return kind(*texts, reason=info.reason)


def _error_info(status: status_pb2.Status) -> error_details_pb2.ErrorInfo | None:
    for detail in status.details:
        info = error_details_pb2.ErrorInfo()
        if detail.Unpack(info) and info.domain == DOMAIN:
            return info
    return None
