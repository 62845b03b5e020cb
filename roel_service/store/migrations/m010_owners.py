"""Version 10: on whose behalf rows were made, and how much callers may have."""

from __future__ import annotations

from sqlalchemy import Connection

_OWNED = ("event_stream", "operation", "blob", "upload")
_LIMITED = ("max_stored_bytes", "max_event_streams", "max_unfinished_operations")


def migrate(connection: Connection) -> None:
    """Add the columns; what is there belongs to nobody, and nobody is limited."""
    for table in _OWNED:
        connection.exec_driver_sql(
            f"ALTER TABLE {table} ADD COLUMN owner VARCHAR NOT NULL DEFAULT ''"
        )
        connection.exec_driver_sql(f"CREATE INDEX {table}_owner ON {table} (owner)")
    for column in _LIMITED:
        connection.exec_driver_sql(f"ALTER TABLE principal ADD COLUMN {column} BIGINT")
