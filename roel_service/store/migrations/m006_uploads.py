"""Version 6: blobs that clients send."""

from __future__ import annotations

from sqlalchemy import Connection

TABLES = (
    """
    CREATE TABLE blob (
        sha256 VARCHAR NOT NULL,
        size_bytes BIGINT NOT NULL,
        create_time_us BIGINT NOT NULL,
        last_used_us BIGINT NOT NULL,
        PRIMARY KEY (sha256)
    )
    """,
    """
    CREATE TABLE upload (
        id VARCHAR NOT NULL,
        sha256 VARCHAR NOT NULL,
        size_bytes BIGINT NOT NULL,
        committed_bytes BIGINT NOT NULL,
        fence BIGINT NOT NULL,
        expire_time_us BIGINT NOT NULL,
        PRIMARY KEY (id)
    )
    """,
)


def migrate(connection: Connection) -> None:
    """Make the tables of uploads and of blobs that nothing else names."""
    for table in TABLES:
        connection.exec_driver_sql(table)
