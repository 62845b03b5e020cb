"""Who changed what: one row for every call that may change something."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import delete, insert, select

from roel_service.store.database import Database
from roel_service.store.records import now_us
from roel_service.store.schema import AUDIT


@dataclass(frozen=True, kw_only=True)
class AuditEntry:
    """One call.

    Attributes:
        time_us: its end, microseconds since 1970.
        principal: who called.
        method: `/package.Service/Method`.
        resource: what the request named; empty if it named nothing.
        code: how it ended, as gRPC names it.
    """

    time_us: int
    principal: str
    method: str
    resource: str
    code: str


class Audit:
    """Repository of the newest entries.

    Args:
        row_count: so many are kept.
    """

    def __init__(self, database: Database, row_count: int) -> None:
        self._database = database
        self._row_count = row_count

    def add(self, *, principal: str, method: str, resource: str, code: str) -> None:
        """Write a row, and drop those that are too many."""
        row = {
            "time_us": now_us(),
            "principal": principal,
            "method": method,
            "resource": resource,
            "code": code,
        }
        with self._database.write() as connection:
            (number,) = connection.execute(insert(AUDIT), row).inserted_primary_key or (0,)
            connection.execute(delete(AUDIT).where(AUDIT.c.id <= number - self._row_count))

    def newest(self, limit: int) -> list[AuditEntry]:
        """The last entries, newest first."""
        columns = [column for column in AUDIT.c if column is not AUDIT.c.id]
        query = select(*columns).order_by(AUDIT.c.id.desc()).limit(limit)
        with self._database.read() as connection:
            rows = connection.execute(query).mappings()
            return [AuditEntry(**{str(key): value for key, value in row.items()}) for row in rows]
