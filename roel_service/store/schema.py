"""Tables, and the numbered forward-only migrations that make them."""

from __future__ import annotations

from collections.abc import Callable

from sqlalchemy import (
    BigInteger,
    Column,
    Connection,
    Float,
    ForeignKey,
    Integer,
    LargeBinary,
    MetaData,
    String,
    Table,
    text,
)

from roel_service.errors import StateError

METADATA = MetaData()

# Times of day are microseconds since 1970 (UTC); times of events are on the clock of the poses.
EVENT_STREAM = Table(
    "event_stream",
    METADATA,
    Column("id", String, primary_key=True),
    Column("uid", String, nullable=False, unique=True),
    Column("state", String, nullable=False),
    Column("camera", String, nullable=False),
    Column("chunk_count", BigInteger, nullable=False),
    Column("event_count", BigInteger, nullable=False),
    Column("size_bytes", BigInteger, nullable=False),
    Column("start_us", BigInteger, nullable=False),
    Column("end_us", BigInteger, nullable=False),
    Column("pose_count", BigInteger, nullable=False),
    Column("digest", String, nullable=False),
    Column("create_time_us", BigInteger, nullable=False),
)

EVENT_CHUNK = Table(
    "event_chunk",
    METADATA,
    Column("stream_uid", ForeignKey("event_stream.uid", ondelete="CASCADE"), primary_key=True),
    Column("seq", BigInteger, primary_key=True),
    Column("t0_us", BigInteger, nullable=False),
    Column("t1_us", BigInteger, nullable=False),
    Column("event_count", Integer, nullable=False),
    Column("offset", BigInteger, nullable=False),
    Column("length", Integer, nullable=False),
    Column("sha256", String, nullable=False),
)

POSE_PART = Table(
    "pose_part",
    METADATA,
    Column("stream_uid", ForeignKey("event_stream.uid", ondelete="CASCADE"), primary_key=True),
    Column("seq", BigInteger, primary_key=True),
    Column("pose_count", Integer, nullable=False),
    Column("t0_us", BigInteger, nullable=False),
    Column("t1_us", BigInteger, nullable=False),
    Column("sha256", String, nullable=False),
)

MAP = Table(
    "map",
    METADATA,
    Column("id", String, primary_key=True),
    Column("version_count", BigInteger, nullable=False),
    Column("create_time_us", BigInteger, nullable=False),
)

MAP_VERSION = Table(
    "map_version",
    METADATA,
    Column("map_id", ForeignKey("map.id", ondelete="CASCADE"), primary_key=True),
    Column("version", BigInteger, primary_key=True),
    Column("state", String, nullable=False),
    Column("event_stream_id", String, nullable=False),
    Column("operation_id", String, nullable=False),
    Column("sha256", String, nullable=False),
    Column("size_bytes", BigInteger, nullable=False),
    Column("line_count", BigInteger, nullable=False),
    Column("bounds_m", String, nullable=False),
    Column("report", String, nullable=False),
    Column("create_time_us", BigInteger, nullable=False),
)

OPERATION = Table(
    "operation",
    METADATA,
    Column("id", String, primary_key=True),
    Column("map_id", ForeignKey("map.id", ondelete="CASCADE"), nullable=False),
    Column("version", BigInteger, nullable=False),
    Column("event_stream_id", String, nullable=False),
    Column("state", String, nullable=False),
    Column("stage", String, nullable=False),
    Column("done_count", BigInteger, nullable=False),
    Column("total_count", BigInteger, nullable=False),
    Column("fraction", Float, nullable=False),
    Column("error", LargeBinary, nullable=False),
    Column("update_seq", BigInteger, nullable=False),
    Column("create_time_us", BigInteger, nullable=False),
    Column("end_time_us", BigInteger, nullable=False),
)


def _create_tables(connection: Connection) -> None:
    METADATA.create_all(connection)


# Migration k leads from version k to k + 1; a released one is never changed.
MIGRATIONS: tuple[Callable[[Connection], None], ...] = (_create_tables,)


def migrate(connection: Connection) -> None:
    """Bring the tables to the newest version.

    Raises:
        StateError: the folder was written by a newer release.
    """
    version = connection.execute(text("PRAGMA user_version")).scalar_one()
    if version > len(MIGRATIONS):
        expected = f"a data folder of version {len(MIGRATIONS)} or older"
        raise StateError("data folder", expected, f"version {version}", reason="DATA_TOO_NEW")
    for step in MIGRATIONS[version:]:
        step(connection)
    connection.execute(text(f"PRAGMA user_version = {len(MIGRATIONS)}"))
