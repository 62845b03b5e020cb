"""The exception tree as `google.rpc.Status`, and back.

A status carries one `ErrorInfo`: reason, domain, and in its metadata the class, subject, expected
and found, so that a caller far away gets the exception that was raised here.
"""

from __future__ import annotations

import json

from google.rpc import code_pb2, error_details_pb2, status_pb2

from roel_service import errors
from roel_service.errors import Cancelled, RoelError

DOMAIN = "roel-service"
# A status travels in headers, which gRPC refuses beyond 16 KiB: four texts of this length fit even
# when every character takes four bytes and the headers' encodings add to that.
MAX_TEXT_LENGTH = 300

# The first class that an error is an instance of decides; subclasses stand before their bases.
CODES: tuple[tuple[type[RoelError], int], ...] = (
    (errors.InputError, code_pb2.INVALID_ARGUMENT),
    (errors.NoAnswerError, code_pb2.FAILED_PRECONDITION),
    (errors.NotFoundError, code_pb2.NOT_FOUND),
    (errors.ConflictError, code_pb2.ABORTED),
    (errors.StateError, code_pb2.FAILED_PRECONDITION),
    (errors.LimitError, code_pb2.RESOURCE_EXHAUSTED),
    (errors.UnavailableError, code_pb2.UNAVAILABLE),
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
    code = next(code for kind, code in CODES if isinstance(error, kind))
    status = status_pb2.Status(code=code, message=str(error)[:MAX_TEXT_LENGTH])
    status.details.add().Pack(info)
    return status


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
    info = _error_info(status)
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
