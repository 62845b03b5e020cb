"""Version 5: a recording has one writer at a time, and tells how good it is while it is made."""

from __future__ import annotations

from sqlalchemy import Connection

STATEMENTS = (
    "ALTER TABLE event_stream ADD COLUMN fence BIGINT NOT NULL DEFAULT 0",
    "ALTER TABLE event_stream ADD COLUMN longest_gap_us BIGINT NOT NULL DEFAULT 0",
    # JSON; an empty list counts as the whole time of the part.
    "ALTER TABLE pose_part ADD COLUMN covered_us VARCHAR NOT NULL DEFAULT '[]'",
    "CREATE INDEX event_chunk_time ON event_chunk (stream_uid, t0_us)",
)


def migrate(connection: Connection) -> None:
    """Add the columns, and the index by time."""
    for statement in STATEMENTS:
        connection.exec_driver_sql(statement)
