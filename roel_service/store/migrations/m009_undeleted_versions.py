"""Version 9: what a deleted version was before."""

from __future__ import annotations

from sqlalchemy import Connection


def migrate(connection: Connection) -> None:
    """Add the column; versions that are deleted already cannot be undeleted."""
    connection.exec_driver_sql(
        "ALTER TABLE map_version ADD COLUMN deleted_state VARCHAR NOT NULL DEFAULT ''"
    )
