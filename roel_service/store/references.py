"""Which blobs the rows name; the others may go."""

from __future__ import annotations

from sqlalchemy import Connection, select

from roel_service.store.blobs import BlobStore
from roel_service.store.database import Database
from roel_service.store.schema import EVENT_STREAM, MAP_VERSION, POSE_PART

# What a row holds in place of a digest until its blob exists.
NO_BLOB = ""

DIGEST_COLUMNS = (EVENT_STREAM.c.digest, POSE_PART.c.sha256, MAP_VERSION.c.sha256)


def referenced(connection: Connection) -> set[str]:
    """Digests of all blobs that rows name."""
    columns = [connection.scalars(select(column)) for column in DIGEST_COLUMNS]
    return {digest for column in columns for digest in column} - {NO_BLOB}


def delete_unreferenced(database: Database, blobs: BlobStore, digests: set[str]) -> None:
    """Delete those of some blobs that no row names any more.

    A transaction of its own: within the one that deletes the rows a crash could leave rows without
    blobs, and without one another writer could just be taking the same blob up.
    """
    with database.write() as connection:
        for digest in digests - referenced(connection) - {NO_BLOB}:
            blobs.delete(digest)
