"""SQLite behind SQLAlchemy Core: many readers, one writer, durable commits."""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sqlalchemy import Connection, create_engine, event
from sqlalchemy.pool import ConnectionPoolEntry

from roel_service.failpoints import failpoint
from roel_service.store.migrations import check_version, is_current, migrate

PRAGMAS = (
    "PRAGMA journal_mode = WAL",
    "PRAGMA synchronous = FULL",
    "PRAGMA busy_timeout = 5000",
    "PRAGMA foreign_keys = ON",
)


class Database:
    """The rows of one data folder, opened by one process at a time."""

    def __init__(self, path: Path) -> None:
        # Autocommit leaves BEGIN and COMMIT to `write`: the driver would begin late and deferred.
        self._engine = create_engine(f"sqlite:///{path}", isolation_level="AUTOCOMMIT")
        event.listen(self._engine, "connect", _configure)
        self._lock = threading.Lock()

    def migrate(self) -> None:
        """Bring the tables to the newest version; raises `StateError` DATA_TOO_NEW."""
        with self.write() as connection:
            migrate(connection)

    def check_version(self) -> None:
        """Raise `StateError` DATA_TOO_NEW or DATA_TOO_OLD unless the tables are of this release."""
        with self.read() as connection:
            check_version(connection)

    def is_current(self) -> bool:
        """Whether the tables are of the newest version."""
        with self.read() as connection:
            return is_current(connection)

    @contextmanager
    def write(self) -> Iterator[Connection]:
        """One transaction; files that belong to it become durable while it is open."""
        with self._lock, self._engine.connect() as connection:
            connection.exec_driver_sql("BEGIN IMMEDIATE")
            try:
                yield connection
            except BaseException:
                connection.exec_driver_sql("ROLLBACK")
                raise
            failpoint("rows.written")
            connection.exec_driver_sql("COMMIT")
            failpoint("rows.committed")

    @contextmanager
    def read(self) -> Iterator[Connection]:
        """Statements that each see the newest commit."""
        with self._engine.connect() as connection:
            yield connection

    @contextmanager
    def snapshot(self) -> Iterator[Connection]:
        """Statements that all see the same commit."""
        with self._engine.connect() as connection:
            connection.exec_driver_sql("BEGIN")
            try:
                yield connection
            finally:
                connection.exec_driver_sql("ROLLBACK")

    def close(self) -> None:
        """Give back every connection."""
        self._engine.dispose()


def _configure(connection: sqlite3.Connection, _: ConnectionPoolEntry) -> None:
    for pragma in PRAGMAS:
        connection.execute(pragma)
