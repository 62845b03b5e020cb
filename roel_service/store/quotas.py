"""On whose behalf rows are made, and how much each caller may have.

Who calls is known at the edge of the server alone. Everything that is made on the way from there
belongs to that caller; what the server does by itself belongs to nobody, and is not limited.
"""

from __future__ import annotations

from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import Connection, Select, func, select

from roel_service.errors import LimitError
from roel_service.store.database import Database
from roel_service.store.records import UNFINISHED
from roel_service.store.schema import BLOB, EVENT_STREAM, OPERATION, UPLOAD


@dataclass(frozen=True, kw_only=True)
class Quota:
    """What a caller may have; None is no limit.

    Attributes:
        stored_bytes: of recordings, and of blobs for as long as they are kept for themselves.
        event_streams: recordings.
        unfinished_operations: builds and other operations that wait or run.
    """

    stored_bytes: int | None = None
    event_streams: int | None = None
    unfinished_operations: int | None = None


@dataclass(frozen=True, kw_only=True)
class Caller:
    """Somebody on whose behalf something is done; an empty name is nobody's."""

    name: str = ""
    quota: Quota = field(default_factory=Quota)


@dataclass(frozen=True, kw_only=True)
class Holdings:
    """What a caller has; see `Quota`."""

    stored_bytes: int
    event_streams: int
    unfinished_operations: int


CALLER: ContextVar[Caller] = ContextVar("caller", default=Caller())  # noqa: B039 (frozen)


def holdings_of(database: Database, caller: Caller) -> Holdings:
    """What a caller has at one moment."""
    with database.snapshot() as connection:
        return Holdings(
            stored_bytes=_stored_bytes(connection, caller),
            event_streams=_count(connection, _streams_of(caller)),
            unfinished_operations=_count(connection, _operations_of(caller)),
        )


def check_stored_bytes(connection: Connection, more_bytes: int) -> None:
    """Raise `LimitError` QUOTA_STORAGE if the caller may not have so much more."""
    caller = CALLER.get()
    limit_bytes = caller.quota.stored_bytes
    if limit_bytes is None:
        return
    found_bytes = _stored_bytes(connection, caller) + more_bytes
    if found_bytes > limit_bytes:
        subject, expected = f"stored bytes of {caller.name}", f"at most {limit_bytes}"
        raise LimitError(subject, expected, f"{found_bytes}", reason="QUOTA_STORAGE")


def check_event_streams(connection: Connection) -> None:
    """Raise `LimitError` QUOTA_EVENT_STREAMS if the caller may not have one more."""
    caller = CALLER.get()
    limit = caller.quota.event_streams
    if limit is not None and _count(connection, _streams_of(caller)) >= limit:
        subject, expected = f"recordings of {caller.name}", f"at most {limit}"
        raise LimitError(subject, expected, "one more", reason="QUOTA_EVENT_STREAMS")


def check_operations(connection: Connection) -> None:
    """Raise `LimitError` QUOTA_CONCURRENT_BUILDS if the caller may not have one more."""
    caller = CALLER.get()
    limit = caller.quota.unfinished_operations
    if limit is not None and _count(connection, _operations_of(caller)) >= limit:
        subject, expected = f"operations of {caller.name}", f"at most {limit} at a time"
        raise LimitError(subject, expected, "one more", reason="QUOTA_CONCURRENT_BUILDS")


def _stored_bytes(connection: Connection, caller: Caller) -> int:
    owned = (
        select(func.coalesce(func.sum(table.c.size_bytes), 0)).where(table.c.owner == caller.name)
        for table in (EVENT_STREAM, BLOB, UPLOAD)
    )
    return sum(connection.execute(select(*(part.scalar_subquery() for part in owned))).one())


def _streams_of(caller: Caller) -> Select[Any]:
    return select(func.count()).select_from(EVENT_STREAM).where(EVENT_STREAM.c.owner == caller.name)


def _operations_of(caller: Caller) -> Select[Any]:
    unfinished = OPERATION.c.state.in_([state.value for state in UNFINISHED])
    owned = OPERATION.c.owner == caller.name
    return select(func.count()).select_from(OPERATION).where(owned, unfinished)


def _count(connection: Connection, query: Select[Any]) -> int:
    return int(connection.execute(query).scalar_one())
