"""Request ids: a request that comes twice has the result of the first time."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from sqlalchemy import Connection, delete, insert, select

from roel_service.errors import InputError
from roel_service.store.records import Row, now_us, row_from_record
from roel_service.store.retention import DAY_US, REQUEST_RETENTION_DAYS
from roel_service.store.schema import REQUEST

Result = TypeVar("Result")


@dataclass(frozen=True, kw_only=True)
class RequestId:
    """What a caller named a request, and what it asked for.

    Attributes:
        id: a UUID.
        content_sha256: hexadecimal digest of the method and of all but the id.
    """

    id: str
    content_sha256: str


@dataclass(frozen=True)
class Memory(Generic[Result]):
    """How the result of a method is remembered: as a text, and back."""

    to_text: Callable[[Result], str]
    from_text: Callable[[str], Result]


def once(
    connection: Connection,
    request: RequestId | None,
    memory: Memory[Result],
    act: Callable[[], Result],
) -> Result:
    """The result of `act`, or of the first call with the same request id.

    Acting and remembering share the transaction: the id is remembered if and only if what was done
    is there. A request without an id is always acted upon.

    Raises:
        InputError: REQUEST_ID_REUSED, the first call had another content.
    """
    if request is None:
        return act()
    delete_expired_requests(connection)
    known = recall(connection, request, memory)
    if known is not None:
        return known
    result = act()
    connection.execute(insert(REQUEST), _row(request, memory.to_text(result)))
    return result


def recall(
    connection: Connection, request: RequestId | None, memory: Memory[Result]
) -> Result | None:
    """The result of the first call with the same request id; None if there was none.

    Raises:
        InputError: REQUEST_ID_REUSED, the first call had another content.
    """
    if request is None:
        return None
    known = connection.execute(
        select(REQUEST.c.content_sha256, REQUEST.c.result).where(
            REQUEST.c.id == request.id, REQUEST.c.expire_time_us > now_us()
        )
    ).one_or_none()
    if known is None:
        return None
    if known.content_sha256 != request.content_sha256:
        expected = "an id of this request alone"
        raise InputError("request_id", expected, "one of another", reason="REQUEST_ID_REUSED")
    return memory.from_text(known.result)


def row_memory(from_row: Callable[[Row], Result]) -> Memory[Result]:
    """Remembers a record as its row, which `from_row` makes a record again."""
    return Memory(
        lambda record: json.dumps(row_from_record(record)), lambda text: from_row(json.loads(text))
    )


def delete_expired_requests(connection: Connection) -> None:
    """Forget the requests of long ago."""
    connection.execute(delete(REQUEST).where(REQUEST.c.expire_time_us <= now_us()))


def _row(request: RequestId, result: str) -> dict[str, str | int]:
    return {
        "id": request.id,
        "content_sha256": request.content_sha256,
        "result": result,
        "expire_time_us": now_us() + REQUEST_RETENTION_DAYS * DAY_US,
    }
