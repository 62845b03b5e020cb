"""Version 7: who may call, and who changed what."""

from __future__ import annotations

from sqlalchemy import Connection

STATEMENTS = (
    """
    CREATE TABLE principal (
        name VARCHAR NOT NULL,
        role VARCHAR NOT NULL,
        token_sha256 VARCHAR NOT NULL,
        create_time_us BIGINT NOT NULL,
        expire_time_us BIGINT NOT NULL,
        PRIMARY KEY (name),
        UNIQUE (token_sha256)
    )
    """,
    """
    CREATE TABLE audit (
        id INTEGER NOT NULL,
        time_us BIGINT NOT NULL,
        principal VARCHAR NOT NULL,
        method VARCHAR NOT NULL,
        resource VARCHAR NOT NULL,
        code VARCHAR NOT NULL,
        PRIMARY KEY (id)
    )
    """,
)


def migrate(connection: Connection) -> None:
    """Make the tables of principals and of the audit."""
    for statement in STATEMENTS:
        connection.exec_driver_sql(statement)
