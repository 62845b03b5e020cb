"""Errors that repeat the names the user gave."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from roel_service.errors import RoelError


@contextmanager
def naming(names: Mapping[str, str]) -> Iterator[None]:
    """Let errors about a key of `names` be about its value.

    Below the readers nobody knows file names: an error about `poses` becomes one about `desk.txt`.
    """
    try:
        yield
    except RoelError as error:
        if error.subject not in names:
            raise
        name = names[error.subject]
        raise type(error)(name, error.expected, error.found, reason=error.reason) from error
