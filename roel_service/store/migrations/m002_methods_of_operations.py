"""Version 2: an operation does any method, not only a build, and expires."""

from __future__ import annotations

from sqlalchemy import Connection

# SQLite cannot change a column or drop a foreign key: the table is made anew and filled.
STATEMENTS = (
    """
    CREATE TABLE new_operation (
        id VARCHAR NOT NULL,
        method VARCHAR NOT NULL,
        request_sha256 VARCHAR NOT NULL,
        map_id VARCHAR NOT NULL,
        version BIGINT NOT NULL,
        event_stream_id VARCHAR NOT NULL,
        state VARCHAR NOT NULL,
        stage VARCHAR NOT NULL,
        done_count BIGINT NOT NULL,
        total_count BIGINT NOT NULL,
        fraction FLOAT NOT NULL,
        metadata BLOB NOT NULL,
        result BLOB NOT NULL,
        error BLOB NOT NULL,
        update_seq BIGINT NOT NULL,
        create_time_us BIGINT NOT NULL,
        end_time_us BIGINT NOT NULL,
        expire_time_us BIGINT NOT NULL,
        PRIMARY KEY (id)
    )
    """,
    # Those that have ended expire 30 days after their end.
    """
    INSERT INTO new_operation
    SELECT id, 'BuildMap', '', map_id, version, event_stream_id, state, stage, done_count,
           total_count, fraction, x'', x'', error, update_seq, create_time_us, end_time_us,
           CASE end_time_us WHEN 0 THEN 0 ELSE end_time_us + 2592000000000 END
    FROM operation
    """,
    "DROP TABLE operation",
    "ALTER TABLE new_operation RENAME TO operation",
    "CREATE INDEX operation_state ON operation (state)",
    "CREATE INDEX operation_expire_time ON operation (expire_time_us)",
)


def migrate(connection: Connection) -> None:
    """Make the table of operations anew."""
    for statement in STATEMENTS:
        connection.exec_driver_sql(statement)
