"""Batches as callers meet them: requests in a message or a manifest, answers as a file."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

from google.longrunning import operations_pb2

from roel_service.errors import InputError, LimitError
from roel_service.jobs.scheduler import Scheduler
from roel_service.service.operations import submitted
from roel_service.service.requests import content_sha256, request_id
from roel_service.service.settings import Settings
from roel_service.store.records import OperationMethod, OperationRecord
from roel_service.store.requests import RequestId
from roel_service.store.store import Store
from roel_service.wire import names
from roel_service.wire.delimited import delimited, messages

SUBJECT = "manifest"


class Manifest(NamedTuple):
    """A manifest in the store.

    Attributes:
        named: digests of the blobs that its requests name.
    """

    sha256: str
    item_count: int
    named: list[str]


class Batching:
    """Begins batches.

    Args:
        kind: class of the requests.
        blob_field: field of a request that may name a blob.
    """

    def __init__(
        self,
        store: Store,
        scheduler: Scheduler,
        settings: Settings,
        method: OperationMethod,
        kind: Any,
        blob_field: str,
    ) -> None:
        self._store = store
        self._scheduler = scheduler
        self._settings = settings
        self._method = method
        self._kind = kind
        self._blob_field = blob_field

    async def begin(self, request: Any) -> operations_pb2.Operation:
        """The operation of a request.

        Raises:
            InputError: MANIFEST_INVALID, or neither requests nor a manifest.
            LimitError: too many requests, or QUEUE_FULL.
            NotFoundError: no such manifest.
        """
        names.check_parent(request.parent)
        identity = request_id(request)
        begin = partial(self._begin, request, identity)
        return await submitted(self._store, self._scheduler, begin, identity)

    def _begin(self, request: Any, identity: RequestId | None) -> OperationRecord:
        manifest = self._manifest(request)
        return self._store.batches.begin(
            self._method,
            manifest.sha256,
            manifest.item_count,
            named=manifest.named,
            request_sha256=content_sha256(request),
            request=identity,
        )

    def _manifest(self, request: Any) -> Manifest:
        batches = self._store.batches
        if bool(request.requests) == request.HasField("manifest"):
            raise InputError("requests", "requests or a manifest", "both or none")
        if request.requests:
            sha256 = batches.put_manifest(b"".join(map(delimited, request.requests)))
        else:
            sha256 = names.checked_sha256(request.manifest.sha256)
        item_count, named = 0, set()
        with batches.blob_path(sha256).open("rb") as file:
            for item in messages(
                file, self._kind, subject=SUBJECT, max_bytes=self._settings.message_in_bytes
            ):
                item_count += 1
                self._check_count(item_count)
                named.add(getattr(item, self._blob_field).sha256)
        if item_count == 0:
            raise InputError(SUBJECT, "requests", "none", reason="MANIFEST_INVALID")
        return Manifest(sha256, item_count, sorted(filter(names.is_sha256, named)))

    def _check_count(self, count: int) -> None:
        if count > self._settings.batch_item_count:
            expected = f"at most {self._settings.batch_item_count} requests"
            raise LimitError(SUBJECT, expected, "more")
