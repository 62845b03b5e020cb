"""Version 8: files that operations answer with, and the refined poses of a version."""

from __future__ import annotations

from sqlalchemy import Connection

STATEMENTS = (
    "ALTER TABLE operation ADD COLUMN result_sha256 VARCHAR NOT NULL DEFAULT ''",
    "ALTER TABLE map_version ADD COLUMN trajectory_sha256 VARCHAR NOT NULL DEFAULT ''",
    "ALTER TABLE map_version ADD COLUMN trajectory_bytes BIGINT NOT NULL DEFAULT 0",
)


def migrate(connection: Connection) -> None:
    """Let rows name the files, so that these stay as long as the rows do."""
    for statement in STATEMENTS:
        connection.exec_driver_sql(statement)
