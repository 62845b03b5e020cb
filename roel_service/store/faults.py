"""Failures that are the disk's, not the program's."""

from __future__ import annotations

import errno
import logging

from sqlalchemy.exc import OperationalError

from roel_service.errors import UnavailableError

logger = logging.getLogger(__name__)

# No space, no quota, a file that may not grow, a disk that fails, a file system gone read-only.
_OF_THE_DISK = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS}


def store_failure(error: BaseException) -> UnavailableError | None:
    """What to answer when files or rows could not be read or written, once that is logged.

    None for any other exception. What a call had not been told to be durable is not there.
    """
    if isinstance(error, OSError) and error.errno in _OF_THE_DISK:
        found = str(error.strerror)
    elif isinstance(error, OperationalError):
        found = str(error.orig)
    else:
        return None
    logger.error("the data folder cannot be used: %s", found)
    return UnavailableError(
        "data folder", "one that can be read and written", found, reason="STORE_UNAVAILABLE"
    )
