"""Version 3: the work of an operation has a row of its own, with attempts and leases."""

from __future__ import annotations

from sqlalchemy import Connection

# Unfinished operations of older versions get no task: what they would run on was never written.
STATEMENTS = (
    """
    CREATE TABLE task (
        id VARCHAR NOT NULL,
        operation_id VARCHAR NOT NULL,
        state VARCHAR NOT NULL,
        parameters BLOB NOT NULL,
        inputs VARCHAR NOT NULL,
        attempt_count INTEGER NOT NULL,
        memory_doublings INTEGER NOT NULL,
        failure_hash VARCHAR NOT NULL,
        not_before_us BIGINT NOT NULL,
        lease_owner VARCHAR NOT NULL,
        lease_until_us BIGINT NOT NULL,
        fence BIGINT NOT NULL,
        PRIMARY KEY (id),
        FOREIGN KEY(operation_id) REFERENCES operation (id) ON DELETE CASCADE
    )
    """,
    "CREATE INDEX task_operation ON task (operation_id)",
    "CREATE INDEX task_state ON task (state, not_before_us)",
)


def migrate(connection: Connection) -> None:
    """Make the table of tasks."""
    for statement in STATEMENTS:
        connection.exec_driver_sql(statement)
