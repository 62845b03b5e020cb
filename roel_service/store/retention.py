"""How long what is over is remembered."""

from __future__ import annotations

DAY_US = 24 * 3600 * 1_000_000

# From the end of an operation, the deletion of a map, and the first call with a request id.
OPERATION_RETENTION_DAYS = 30
DELETED_MAP_RETENTION_DAYS = 30
REQUEST_RETENTION_DAYS = 7

# From the last part of an upload, and from the last use of a blob that no row names.
UPLOAD_RETENTION_DAYS = 1
