"""Etags: a change that names the state it was decided on is refused when that has changed."""

from __future__ import annotations

from roel_service.errors import ConflictError


def check_etag(current: str, given: str) -> None:
    """Raise `ConflictError` ETAG_MISMATCH unless none is given or it is the current one."""
    if given and given != current:
        raise ConflictError("etag", current, given, reason="ETAG_MISMATCH")
