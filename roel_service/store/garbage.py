"""What nobody needs any more goes: never inside a request, and never before an upload could end."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from roel_service.failpoints import failpoint
from roel_service.store.blobs import BlobStore, StoredBlob
from roel_service.store.database import Database
from roel_service.store.references import referenced

# An upload may be taken up again for this long, and its blobs are named by a row only at its end.
LONGEST_UPLOAD_S = 24 * 3600.0

# Files deleted in one transaction: other writers wait for a few milliseconds at most.
BATCH_COUNT = 32


@dataclass(frozen=True, kw_only=True)
class Swept:
    """What a sweep deleted, and what is left."""

    deleted_blob_count: int
    deleted_bytes: int
    kept_blob_count: int
    kept_bytes: int


def sweep_blobs(database: Database, blobs: BlobStore, unused_for_s: float) -> Swept:
    """Delete blobs that no row names and that nobody has put for a time."""
    before_s = time.time() - unused_for_s
    with database.read() as connection:
        marked = referenced(connection)
    found = list(blobs.stored())
    loose = [blob for blob in found if blob.sha256 not in marked and blob.used_s < before_s]
    deleted = [
        blob
        for batch in _batches(loose)
        for blob in _delete_loose(database, blobs, batch, before_s)
    ]
    blobs.discard_parts(before_s)
    deleted_bytes = sum(blob.size_bytes for blob in deleted)
    return Swept(
        deleted_blob_count=len(deleted),
        deleted_bytes=deleted_bytes,
        kept_blob_count=len(found) - len(deleted),
        kept_bytes=sum(blob.size_bytes for blob in found) - deleted_bytes,
    )


def _delete_loose(
    database: Database, blobs: BlobStore, batch: list[StoredBlob], before_s: float
) -> list[StoredBlob]:
    """Those of a batch that are gone; no row can come to name one meanwhile."""
    with database.write() as connection:
        named = referenced(connection)
        deleted = [
            blob
            for blob in batch
            if blob.sha256 not in named and blobs.discard(blob.sha256, before_s)
        ]
    failpoint("sweep.deleted")
    return deleted


def _batches(blobs: Iterable[StoredBlob]) -> Iterator[list[StoredBlob]]:
    iterator = iter(blobs)
    while batch := list(itertools.islice(iterator, BATCH_COUNT)):
        yield batch
