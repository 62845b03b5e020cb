"""Request ids as callers send them."""

from __future__ import annotations

import hashlib
import re
from typing import Any

from roel_service.errors import InputError
from roel_service.store.requests import RequestId

_UUID4 = re.compile(r"[0-9a-f]{8}-[0-9a-f]{4}-4[0-9a-f]{3}-[89ab][0-9a-f]{3}-[0-9a-f]{12}")


def request_id(message: Any) -> RequestId | None:
    """What the request is called, if its caller named it.

    Raises:
        InputError: REQUEST_ID_INVALID.
    """
    if not message.request_id:
        return None
    given = message.request_id.lower()
    if not _UUID4.fullmatch(given):
        found = repr(message.request_id[:40])
        reason = "REQUEST_ID_INVALID"
        raise InputError("request_id", "a UUID of version 4", found, reason=reason)
    return RequestId(id=given, content_sha256=content_sha256(message))


def content_sha256(message: Any) -> str:
    """Hexadecimal digest of a request, but for its id: the method, and every other field."""
    content = type(message)()
    content.CopyFrom(message)
    content.ClearField("request_id")
    named = message.DESCRIPTOR.full_name.encode() + b"\0"
    return hashlib.sha256(named + content.SerializeToString(deterministic=True)).hexdigest()
