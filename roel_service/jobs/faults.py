"""What a caller is told of a bug: an id, and nothing else; the rest is in the log."""

from __future__ import annotations

import logging
import uuid

from roel_service.errors import RoelError

logger = logging.getLogger(__name__)


def logged_fault(error: BaseException, where: str) -> RoelError:
    """Log an exception that is no `RoelError` with its traceback; the error to answer with."""
    fault_id = uuid.uuid4().hex[:12]
    logger.error("fault %s in %s", fault_id, where, exc_info=error)
    return RoelError("server", "an answer", f"a fault of the program, logged as {fault_id}")
