"""Tables as they are now; `migrations` makes them."""

from __future__ import annotations

from sqlalchemy import (
    BigInteger,
    Column,
    Float,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    String,
    Table,
)

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
    Column("fence", BigInteger, nullable=False),
    Column("longest_gap_us", BigInteger, nullable=False),
    Column("create_time_us", BigInteger, nullable=False),
    Column("owner", String, nullable=False),
    Column("labels", String, nullable=False),
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
    Index("event_chunk_time", "stream_uid", "t0_us"),
)

POSE_PART = Table(
    "pose_part",
    METADATA,
    Column("stream_uid", ForeignKey("event_stream.uid", ondelete="CASCADE"), primary_key=True),
    Column("seq", BigInteger, primary_key=True),
    Column("pose_count", Integer, nullable=False),
    Column("t0_us", BigInteger, nullable=False),
    Column("t1_us", BigInteger, nullable=False),
    Column("covered_us", String, nullable=False),
    Column("sha256", String, nullable=False),
)

MAP = Table(
    "map",
    METADATA,
    Column("id", String, primary_key=True),
    Column("version_count", BigInteger, nullable=False),
    Column("create_time_us", BigInteger, nullable=False),
    Column("uid", String, nullable=False),
    Column("display_name", String, nullable=False),
    Column("labels", String, nullable=False),
    Column("revision", BigInteger, nullable=False),
    Column("update_time_us", BigInteger, nullable=False),
    Column("delete_time_us", BigInteger, nullable=False),
    Column("purge_time_us", BigInteger, nullable=False),
)

MAP_ALIAS = Table(
    "map_alias",
    METADATA,
    Column("map_id", ForeignKey("map.id", ondelete="CASCADE"), primary_key=True),
    Column("alias", String, primary_key=True),
    Column("version", BigInteger, nullable=False),
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
    Column("imported_file", String, nullable=False),
    Column("provenance", String, nullable=False),
    Column("purge_time_us", BigInteger, nullable=False),
    Column("trajectory_sha256", String, nullable=False),
    Column("trajectory_bytes", BigInteger, nullable=False),
    Column("deleted_state", String, nullable=False),
)

OPERATION = Table(
    "operation",
    METADATA,
    Column("id", String, primary_key=True),
    Column("method", String, nullable=False),
    Column("request_sha256", String, nullable=False),
    Column("map_id", String, nullable=False),
    Column("version", BigInteger, nullable=False),
    Column("event_stream_id", String, nullable=False),
    Column("state", String, nullable=False),
    Column("stage", String, nullable=False),
    Column("done_count", BigInteger, nullable=False),
    Column("total_count", BigInteger, nullable=False),
    Column("fraction", Float, nullable=False),
    Column("metadata", LargeBinary, nullable=False),
    Column("result", LargeBinary, nullable=False),
    Column("error", LargeBinary, nullable=False),
    Column("update_seq", BigInteger, nullable=False),
    Column("create_time_us", BigInteger, nullable=False),
    Column("end_time_us", BigInteger, nullable=False),
    Column("expire_time_us", BigInteger, nullable=False),
    Column("result_sha256", String, nullable=False),
    Column("owner", String, nullable=False),
)

TASK = Table(
    "task",
    METADATA,
    Column("id", String, primary_key=True),
    Column("operation_id", ForeignKey("operation.id", ondelete="CASCADE"), nullable=False),
    Column("state", String, nullable=False),
    Column("parameters", LargeBinary, nullable=False),
    Column("inputs", String, nullable=False),
    Column("attempt_count", Integer, nullable=False),
    Column("memory_doublings", Integer, nullable=False),
    Column("failure_hash", String, nullable=False),
    Column("not_before_us", BigInteger, nullable=False),
    Column("lease_owner", String, nullable=False),
    Column("lease_until_us", BigInteger, nullable=False),
    Column("fence", BigInteger, nullable=False),
)

Index("task_operation", TASK.c.operation_id)
Index("task_state", TASK.c.state, TASK.c.not_before_us)
REQUEST = Table(
    "request",
    METADATA,
    Column("id", String, primary_key=True),
    Column("content_sha256", String, nullable=False),
    Column("result", String, nullable=False),
    Column("expire_time_us", BigInteger, nullable=False),
)

Index("operation_state", OPERATION.c.state)
Index("operation_expire_time", OPERATION.c.expire_time_us)
Index("request_expire_time", REQUEST.c.expire_time_us)
Index("map_purge_time", MAP.c.purge_time_us)
Index("map_version_purge_time", MAP_VERSION.c.purge_time_us)

# Blobs that were uploaded, or asked for: these rows keep them while nothing else names them.
BLOB = Table(
    "blob",
    METADATA,
    Column("sha256", String, primary_key=True),
    Column("size_bytes", BigInteger, nullable=False),
    Column("create_time_us", BigInteger, nullable=False),
    Column("last_used_us", BigInteger, nullable=False),
    Column("owner", String, nullable=False),
)

UPLOAD = Table(
    "upload",
    METADATA,
    Column("id", String, primary_key=True),
    Column("sha256", String, nullable=False),
    Column("size_bytes", BigInteger, nullable=False),
    Column("committed_bytes", BigInteger, nullable=False),
    Column("fence", BigInteger, nullable=False),
    Column("expire_time_us", BigInteger, nullable=False),
    Column("owner", String, nullable=False),
)

PRINCIPAL = Table(
    "principal",
    METADATA,
    Column("name", String, primary_key=True),
    Column("role", String, nullable=False),
    Column("token_sha256", String, nullable=False, unique=True),
    Column("create_time_us", BigInteger, nullable=False),
    Column("expire_time_us", BigInteger, nullable=False),
    Column("max_stored_bytes", BigInteger),
    Column("max_event_streams", BigInteger),
    Column("max_unfinished_operations", BigInteger),
)

AUDIT = Table(
    "audit",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("time_us", BigInteger, nullable=False),
    Column("principal", String, nullable=False),
    Column("method", String, nullable=False),
    Column("resource", String, nullable=False),
    Column("code", String, nullable=False),
)

for _table in (EVENT_STREAM, OPERATION, BLOB, UPLOAD):
    Index(f"{_table.name}_owner", _table.c.owner)
