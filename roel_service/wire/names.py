"""Names of resources: `projects/default/eventStreams/{id}` and its like."""

from __future__ import annotations

import re

from roel_service.errors import InputError, NotFoundError

PROJECT = "projects/default"
LATEST = "latest"

_ID = re.compile(r"[a-z][a-z0-9-]{2,62}")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_OPERATION = re.compile(r"operations/([0-9a-f]{32})")
_NUMBER = re.compile(r"v([1-9][0-9]{0,8})")
_VERSION = re.compile(rf"(.+)/versions/(?:{_NUMBER.pattern}|({_ID.pattern}))")

# A version of a map by its number, or by an alias.
VersionLabel = int | str


def checked_id(value: str, subject: str) -> str:
    """`value` if it can name a resource; raises `InputError` ID_INVALID otherwise."""
    if not _ID.fullmatch(value):
        raise InputError(subject, f"an id like {_ID.pattern}", repr(value), reason="ID_INVALID")
    return value


def check_parent(parent: str) -> None:
    """Raises `NotFoundError` unless this is the one project there is."""
    if parent != PROJECT:
        raise NotFoundError("parent", PROJECT, repr(parent))


def is_resource_name(name: str) -> bool:
    """Whether this names something that a server has; a file of such a name is `./projects/...`."""
    return name.startswith(f"{PROJECT}/")


def event_stream_name(event_stream_id: str) -> str:
    """The name of a recording."""
    return f"{PROJECT}/eventStreams/{event_stream_id}"


def event_stream_id(name: str) -> str:
    """The id in a recording's name; raises `InputError` for any other text."""
    return _id_below(name, f"{PROJECT}/eventStreams/")


def map_name(map_id: str) -> str:
    """The name of a map."""
    return f"{PROJECT}/maps/{map_id}"


def map_id(name: str) -> str:
    """The id in a map's name; raises `InputError` for any other text."""
    return _id_below(name, f"{PROJECT}/maps/")


def map_version_name(map_id: str, version: VersionLabel) -> str:
    """The name of a version, by its number or an alias."""
    label = f"v{version}" if isinstance(version, int) else version
    return f"{map_name(map_id)}/versions/{label}"


def map_version_id(name: str) -> tuple[str, VersionLabel]:
    """Map id and number, or alias, in a version's name; raises `InputError` for any other text."""
    match = _VERSION.fullmatch(name)
    if match is None:
        raise _bad_name(name, f"{PROJECT}/maps/ID/versions/vNUMBER or an alias")
    return map_id(match[1]), int(match[2]) if match[2] else match[3]


def map_version_number(name: str) -> tuple[str, int]:
    """Map id and number in a version's name; raises `InputError` for an alias, which may move."""
    found_id, label = map_version_id(name)
    if not isinstance(label, int):
        raise _bad_name(name, f"{PROJECT}/maps/ID/versions/vNUMBER")
    return found_id, label


def checked_alias(value: str) -> str:
    """`value` if a caller may choose it as an alias; raises `InputError` ID_INVALID otherwise."""
    if value == LATEST or _NUMBER.fullmatch(value):
        expected = f"an alias other than {LATEST} and the numbers of versions"
        raise InputError("alias", expected, repr(value), reason="ID_INVALID")
    return checked_id(value, "alias")


def blob_name(sha256: str) -> str:
    """The name of a blob."""
    return f"{PROJECT}/blobs/{sha256}"


def blob_sha256(name: str) -> str:
    """The digest in a blob's name; raises `InputError` for any other text."""
    sha256 = name.removeprefix(f"{PROJECT}/blobs/")
    if sha256 == name or not _SHA256.fullmatch(sha256):
        raise _bad_name(name, f"{PROJECT}/blobs/SHA256")
    return sha256


def checked_sha256(value: str) -> str:
    """`value` if it is a digest; raises `InputError` ID_INVALID otherwise."""
    if not _SHA256.fullmatch(value):
        expected = "64 lower-case hexadecimal digits"
        raise InputError("sha256", expected, repr(value), reason="ID_INVALID")
    return value


def is_sha256(value: str) -> bool:
    """Whether this is a digest."""
    return _SHA256.fullmatch(value) is not None


def operation_name(operation_id: str) -> str:
    """The name of an operation."""
    return f"operations/{operation_id}"


def operation_id(name: str) -> str:
    """The id in an operation's name; raises `InputError` for any other text."""
    match = _OPERATION.fullmatch(name)
    if match is None:
        raise _bad_name(name, "operations/UUID")
    return match[1]


def _id_below(name: str, collection: str) -> str:
    tail = name.removeprefix(collection)
    if tail == name or not _ID.fullmatch(tail):
        raise _bad_name(name, f"{collection}ID")
    return tail


def _bad_name(name: str, expected: str) -> InputError:
    return InputError("name", expected, repr(name), reason="NAME_INVALID")
