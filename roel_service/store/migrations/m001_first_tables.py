"""Version 1: recordings, maps and the operations that build them."""

from __future__ import annotations

from sqlalchemy import Connection

TABLES = (
    """
    CREATE TABLE event_stream (
        id VARCHAR NOT NULL,
        uid VARCHAR NOT NULL,
        state VARCHAR NOT NULL,
        camera VARCHAR NOT NULL,
        chunk_count BIGINT NOT NULL,
        event_count BIGINT NOT NULL,
        size_bytes BIGINT NOT NULL,
        start_us BIGINT NOT NULL,
        end_us BIGINT NOT NULL,
        pose_count BIGINT NOT NULL,
        digest VARCHAR NOT NULL,
        create_time_us BIGINT NOT NULL,
        PRIMARY KEY (id),
        UNIQUE (uid)
    )
    """,
    """
    CREATE TABLE map (
        id VARCHAR NOT NULL,
        version_count BIGINT NOT NULL,
        create_time_us BIGINT NOT NULL,
        PRIMARY KEY (id)
    )
    """,
    """
    CREATE TABLE event_chunk (
        stream_uid VARCHAR NOT NULL,
        seq BIGINT NOT NULL,
        t0_us BIGINT NOT NULL,
        t1_us BIGINT NOT NULL,
        event_count INTEGER NOT NULL,
        "offset" BIGINT NOT NULL,
        length INTEGER NOT NULL,
        sha256 VARCHAR NOT NULL,
        PRIMARY KEY (stream_uid, seq),
        FOREIGN KEY(stream_uid) REFERENCES event_stream (uid) ON DELETE CASCADE
    )
    """,
    """
    CREATE TABLE map_version (
        map_id VARCHAR NOT NULL,
        version BIGINT NOT NULL,
        state VARCHAR NOT NULL,
        event_stream_id VARCHAR NOT NULL,
        operation_id VARCHAR NOT NULL,
        sha256 VARCHAR NOT NULL,
        size_bytes BIGINT NOT NULL,
        line_count BIGINT NOT NULL,
        bounds_m VARCHAR NOT NULL,
        report VARCHAR NOT NULL,
        create_time_us BIGINT NOT NULL,
        PRIMARY KEY (map_id, version),
        FOREIGN KEY(map_id) REFERENCES map (id) ON DELETE CASCADE
    )
    """,
    """
    CREATE TABLE operation (
        id VARCHAR NOT NULL,
        map_id VARCHAR NOT NULL,
        version BIGINT NOT NULL,
        event_stream_id VARCHAR NOT NULL,
        state VARCHAR NOT NULL,
        stage VARCHAR NOT NULL,
        done_count BIGINT NOT NULL,
        total_count BIGINT NOT NULL,
        fraction FLOAT NOT NULL,
        error BLOB NOT NULL,
        update_seq BIGINT NOT NULL,
        create_time_us BIGINT NOT NULL,
        end_time_us BIGINT NOT NULL,
        PRIMARY KEY (id),
        FOREIGN KEY(map_id) REFERENCES map (id) ON DELETE CASCADE
    )
    """,
    """
    CREATE TABLE pose_part (
        stream_uid VARCHAR NOT NULL,
        seq BIGINT NOT NULL,
        pose_count INTEGER NOT NULL,
        t0_us BIGINT NOT NULL,
        t1_us BIGINT NOT NULL,
        sha256 VARCHAR NOT NULL,
        PRIMARY KEY (stream_uid, seq),
        FOREIGN KEY(stream_uid) REFERENCES event_stream (uid) ON DELETE CASCADE
    )
    """,
)


def migrate(connection: Connection) -> None:
    """Make the first tables."""
    for table in TABLES:
        connection.exec_driver_sql(table)
