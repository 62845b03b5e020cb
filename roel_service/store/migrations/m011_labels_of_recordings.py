"""Version 11: recordings have labels."""

from __future__ import annotations

from sqlalchemy import Connection


def migrate(connection: Connection) -> None:
    """Add the column; recordings that are there have none."""
    connection.exec_driver_sql(
        "ALTER TABLE event_stream ADD COLUMN labels VARCHAR NOT NULL DEFAULT '{}'"
    )
