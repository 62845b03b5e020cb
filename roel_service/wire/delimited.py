"""Files of messages, each behind its length as a varint."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, BinaryIO

from google.protobuf.message import DecodeError

from roel_service.errors import InputError

# A varint of more bytes counts more than any file holds.
MAX_VARINT_BYTES = 5


def delimited(message: Any) -> bytes:
    """One message of a file."""
    # Map fields have no order of their own.
    data = message.SerializeToString(deterministic=True)
    return _varint(len(data)) + bytes(data)


def messages(file: BinaryIO, kind: Any, *, subject: str, max_bytes: int) -> Iterator[Any]:
    """The messages of a file, one at a time in memory.

    Args:
        kind: their class.
        subject: what errors call the file.
        max_bytes: of one message.

    Raises:
        InputError: MANIFEST_INVALID, with the number of the message from 0.
    """
    index = 0
    while (length := _length(file, subject, index)) is not None:
        if length > max_bytes:
            raise _invalid(subject, f"at most {max_bytes} bytes", f"{length}", index)
        data = file.read(length)
        if len(data) < length:
            raise _invalid(subject, f"{length} bytes", f"{len(data)}", index)
        try:
            yield kind.FromString(data)
        except DecodeError:
            expected = f"a {kind.DESCRIPTOR.name}"
            raise _invalid(subject, expected, "other bytes", index) from None
        index += 1


def _length(file: BinaryIO, subject: str, index: int) -> int | None:
    """The next varint; None at the end of the file."""
    value = 0
    for place in range(MAX_VARINT_BYTES):
        byte = file.read(1)
        if not byte and place == 0:
            return None
        if not byte:
            break
        value |= (byte[0] & 0x7F) << 7 * place
        if byte[0] < 0x80:
            return value
    raise _invalid(subject, "the length of a message", "none", index)


def _varint(value: int) -> bytes:
    data = bytearray()
    while value >= 0x80:
        data.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*data, value])


def _invalid(subject: str, expected: str, found: str, index: int) -> InputError:
    found = f"{found} at message {index}"
    return InputError(subject, expected, found, reason="MANIFEST_INVALID")
