"""What callers call their resources: display names, labels, and which of them an update changes."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

from roel_service.errors import InputError
from roel_service.service.settings import Settings

_KEY = re.compile(r"[a-z][a-z0-9_-]{0,62}")
_MAX_VALUE_LENGTH = 63


def checked_display_name(value: str, settings: Settings) -> str:
    """A display name; raises `InputError` for one that is too long or has control characters."""
    if len(value) > settings.display_name_length or not value.isprintable():
        expected = f"at most {settings.display_name_length} printable characters"
        raise InputError("display_name", expected, repr(value[:80]))
    return value


def checked_labels(labels: Mapping[str, str], settings: Settings) -> dict[str, str]:
    """Labels; raises `InputError` for too many of them, and for a key or value that cannot be."""
    if len(labels) > settings.label_count:
        raise InputError("labels", f"at most {settings.label_count}", f"{len(labels)}")
    for key, value in labels.items():
        if not _KEY.fullmatch(key):
            raise InputError("labels", f"keys like {_KEY.pattern}", repr(key[:80]))
        if len(value) > _MAX_VALUE_LENGTH or not value.isprintable():
            expected = f"values of at most {_MAX_VALUE_LENGTH} printable characters"
            raise InputError(f"labels.{key}", expected, repr(value[:80]))
    return dict(sorted(labels.items()))


# What an update may change, and how it is checked.
_MUTABLE: dict[str, Callable[[Any, Settings], Any]] = {
    "display_name": checked_display_name,
    "labels": checked_labels,
}


def updated_fields(message: Any, paths: list[str], settings: Settings) -> dict[str, Any]:
    """Checked values of the fields that an update names; without names, of those that are present.

    Raises:
        InputError: a field that cannot be changed, or a value that cannot be.
    """
    wanted = paths or [name for name in _MUTABLE if getattr(message, name)]
    unknown = sorted(set(wanted) - set(_MUTABLE))
    if unknown:
        raise InputError("update_mask", f"some of {', '.join(_MUTABLE)}", ", ".join(unknown)[:80])
    return {name: _MUTABLE[name](getattr(message, name), settings) for name in wanted}
