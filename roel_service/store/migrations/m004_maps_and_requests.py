"""Maps get labels, aliases and a second chance after deletion; request ids are remembered."""

from __future__ import annotations

from sqlalchemy import Connection

STATEMENTS = (
    "ALTER TABLE map ADD COLUMN uid VARCHAR NOT NULL DEFAULT ''",
    "ALTER TABLE map ADD COLUMN display_name VARCHAR NOT NULL DEFAULT ''",
    "ALTER TABLE map ADD COLUMN labels VARCHAR NOT NULL DEFAULT '{}'",
    "ALTER TABLE map ADD COLUMN revision BIGINT NOT NULL DEFAULT 1",
    "ALTER TABLE map ADD COLUMN update_time_us BIGINT NOT NULL DEFAULT 0",
    "ALTER TABLE map ADD COLUMN delete_time_us BIGINT NOT NULL DEFAULT 0",
    "ALTER TABLE map ADD COLUMN purge_time_us BIGINT NOT NULL DEFAULT 0",
    "UPDATE map SET uid = lower(hex(randomblob(16))), update_time_us = create_time_us",
    "ALTER TABLE map_version ADD COLUMN imported_file VARCHAR NOT NULL DEFAULT '{}'",
    "ALTER TABLE map_version ADD COLUMN provenance VARCHAR NOT NULL DEFAULT '{}'",
    "ALTER TABLE map_version ADD COLUMN purge_time_us BIGINT NOT NULL DEFAULT 0",
    """
    CREATE TABLE map_alias (
        map_id VARCHAR NOT NULL,
        alias VARCHAR NOT NULL,
        version BIGINT NOT NULL,
        PRIMARY KEY (map_id, alias),
        FOREIGN KEY(map_id) REFERENCES map (id) ON DELETE CASCADE
    )
    """,
    """
    CREATE TABLE request (
        id VARCHAR NOT NULL,
        content_sha256 VARCHAR NOT NULL,
        result VARCHAR NOT NULL,
        expire_time_us BIGINT NOT NULL,
        PRIMARY KEY (id)
    )
    """,
    "CREATE INDEX request_expire_time ON request (expire_time_us)",
    "CREATE INDEX map_purge_time ON map (purge_time_us)",
    "CREATE INDEX map_version_purge_time ON map_version (purge_time_us)",
)


def migrate(connection: Connection) -> None:
    """Extend maps and their versions, and make the table of requests."""
    for statement in STATEMENTS:
        connection.exec_driver_sql(statement)
