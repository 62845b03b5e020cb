"""Which blobs the rows name; the others may go."""

from __future__ import annotations

import json

from sqlalchemy import Connection, select

from roel_service.store.records import TaskState
from roel_service.store.schema import BLOB, EVENT_STREAM, MAP_VERSION, OPERATION, POSE_PART, TASK

# What a row holds in place of a digest until its blob exists.
NO_BLOB = ""

DIGEST_COLUMNS = (
    EVENT_STREAM.c.digest,
    POSE_PART.c.sha256,
    MAP_VERSION.c.sha256,
    MAP_VERSION.c.trajectory_sha256,
    OPERATION.c.result_sha256,
    BLOB.c.sha256,
)

_UNFINISHED_TASK = TASK.c.state.in_([TaskState.READY.value, TaskState.LEASED.value])


def referenced(connection: Connection) -> set[str]:
    """Digests of all blobs that rows name."""
    columns = [connection.scalars(select(column)) for column in DIGEST_COLUMNS]
    named = {digest for column in columns for digest in column}
    inputs = connection.scalars(select(TASK.c.inputs).where(_UNFINISHED_TASK))
    return (named | {digest for text in inputs for digest in json.loads(text)}) - {NO_BLOB}
