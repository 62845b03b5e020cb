"""What a caller is told of a bug: an id, and nothing else; the rest is in the log."""

from __future__ import annotations

import hashlib
import logging
import traceback
import uuid

from roel_service.errors import RoelError

logger = logging.getLogger(__name__)


class FaultError(RoelError):
    """A bug of the work, which is in the log.

    Attributes:
        fingerprint: equal for equal failures.
    """

    def __init__(self, found: str, fingerprint: str) -> None:
        super().__init__("server", "an answer", found)
        self.fingerprint = fingerprint


def logged_fault(error: BaseException, where: str) -> FaultError:
    """Log an exception that is no `RoelError` with its traceback; the error to answer with."""
    fault_id = _new_id()
    logger.error("fault %s in %s", fault_id, where, exc_info=error)
    return _fault(fault_id, fingerprint_of(error))


def logged_failure(details: str, fingerprint: str, where: str) -> FaultError:
    """The same for a failure in another process, of which only a text is left."""
    fault_id = _new_id()
    logger.error("fault %s in %s\n%s", fault_id, where, details)
    return _fault(fault_id, fingerprint)


def fingerprint_of(error: BaseException) -> str:
    """Digest of what failed and where; the text is left out, since it may name addresses."""
    frames = traceback.extract_tb(error.__traceback__)
    places = [f"{frame.name}:{frame.lineno}" for frame in frames]
    return hashlib.sha256("\n".join([type(error).__name__, *places]).encode()).hexdigest()


def _new_id() -> str:
    return uuid.uuid4().hex[:12]


def _fault(fault_id: str, fingerprint: str) -> FaultError:
    return FaultError(f"a fault of the program, logged as {fault_id}", fingerprint)
