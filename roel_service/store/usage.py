"""How much a data folder holds, and how much is going on."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import func, select

from roel_service.store.database import Database
from roel_service.store.records import UNFINISHED
from roel_service.store.schema import EVENT_STREAM, MAP, MAP_VERSION, OPERATION


@dataclass(frozen=True, kw_only=True)
class Usage:
    """Counts, and bytes of files that rows name.

    Attributes:
        event_stream_count, event_stream_bytes: recordings, and their events.
        map_count: maps that are not deleted.
        map_bytes: files of versions, deleted ones included.
        unfinished_operation_count: builds and imports.
    """

    event_stream_count: int
    event_stream_bytes: int
    map_count: int
    map_bytes: int
    unfinished_operation_count: int


def usage_of(database: Database) -> Usage:
    """Usage at one moment."""
    unfinished = OPERATION.c.state.in_([state.value for state in UNFINISHED])
    queries = (
        select(func.count()).select_from(EVENT_STREAM),
        select(func.coalesce(func.sum(EVENT_STREAM.c.size_bytes), 0)),
        select(func.count()).select_from(MAP).where(MAP.c.delete_time_us == 0),
        select(func.coalesce(func.sum(MAP_VERSION.c.size_bytes), 0)),
        select(func.count()).select_from(OPERATION).where(unfinished),
    )
    query = select(*(part.scalar_subquery() for part in queries))
    with database.read() as connection:
        streams, stream_bytes, maps, map_bytes, operations = connection.execute(query).one()
    return Usage(
        event_stream_count=streams,
        event_stream_bytes=stream_bytes,
        map_count=maps,
        map_bytes=map_bytes,
        unfinished_operation_count=operations,
    )
