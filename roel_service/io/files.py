"""Opening inputs and replacing outputs: what every reader and writer shares."""

from __future__ import annotations

import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from roel_service.errors import InputError


def open_input(path: Path) -> BinaryIO:
    """Open a regular file for reading.

    Raises:
        InputError: the file is missing, unreadable, or a folder, pipe or device.
    """
    try:
        # Asked before opening: opening a pipe that nobody writes to would block for ever.
        mode = os.stat(path).st_mode
        if stat.S_ISREG(mode):
            return open(path, "rb")
        found = "a folder" if stat.S_ISDIR(mode) else "a pipe or device"
    except (OSError, ValueError) as error:
        found = _reason(error)
    raise InputError(str(path), "a readable file", found)


def read_input(path: Path, max_bytes: int) -> bytes:
    """The bytes of a small regular file.

    Raises:
        InputError: as `open_input`, or the file is longer than `max_bytes`.
    """
    with open_input(path) as file:
        data = file.read(max_bytes + 1)
    if len(data) > max_bytes:
        raise InputError(str(path), f"at most {max_bytes} bytes", "a longer file")
    return data


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Write a file so that it is either whole or not there.

    Yields a temporary sibling with the same suffix. It replaces `path` when the block ends, its
    data flushed to the disk; it is removed, and `path` left as it was, when the block raises.

    Raises:
        InputError: nothing can be written there.
    """
    target, temporary = _create_sibling(path)
    try:
        yield temporary
        _flush(temporary)
        os.replace(temporary, target)
        _flush(target.parent)
    finally:
        temporary.unlink(missing_ok=True)


def _create_sibling(path: Path) -> tuple[Path, Path]:
    """The file to replace and an empty temporary one beside it."""
    try:
        target = Path(os.path.realpath(path))  # a symbolic link stays one
        if target.exists() and not target.is_file():
            raise InputError(str(path), "a file to write", "a folder or device of that name")
        temporary = target.with_name(f".{secrets.token_hex(8)}{target.suffix}")
        temporary.touch(exist_ok=False)
    except (OSError, ValueError) as error:
        raise InputError(str(path), "a file to write", _reason(error)) from error
    return target, temporary


def _flush(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _reason(error: Exception) -> str:
    """The operating system's words without number and file name."""
    return (getattr(error, "strerror", None) or str(error)).lower()
