"""google.longrunning.Operations and OperationService: operations are watched and ended."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Any

from google.longrunning import operations_pb2
from google.protobuf.empty_pb2 import Empty

from roel_service.errors import NotFoundError
from roel_service.jobs.scheduler import Begin, Scheduler
from roel_service.service.paging import page_of, page_request
from roel_service.service.records import (
    BATCH_ANSWERS,
    batch_answer,
    event_stream_to_proto,
    map_version_to_proto,
    operation_to_proto,
    refinement_answer,
)
from roel_service.store.records import OperationMethod, OperationRecord, OperationState
from roel_service.store.requests import RequestId
from roel_service.store.store import Store
from roel_service.v1 import operations_pb2 as roel_operations_pb2
from roel_service.wire import names


class OperationServicer:
    """Both services over the same rows."""

    def __init__(self, store: Store, scheduler: Scheduler) -> None:
        self._store = store
        self._scheduler = scheduler

    async def GetOperation(
        self, request: operations_pb2.GetOperationRequest, context: Any
    ) -> operations_pb2.Operation:
        return await self._encoded(await self._record(names.operation_id(request.name)))

    async def ListOperations(
        self, request: operations_pb2.ListOperationsRequest, context: Any
    ) -> operations_pb2.ListOperationsResponse:
        wanted = page_request("operations", request.page_size, request.page_token)
        fetch = self._store.operations.page
        page = await asyncio.to_thread(page_of, wanted, fetch, lambda item: item.id)
        return operations_pb2.ListOperationsResponse(
            operations=[await self._encoded(item) for item in page.items],
            next_page_token=page.next_page_token,
        )

    async def CancelOperation(
        self, request: operations_pb2.CancelOperationRequest, context: Any
    ) -> Empty:
        record = await self._record(names.operation_id(request.name))
        await self._scheduler.cancel(record.id)
        return Empty()

    async def DeleteOperation(
        self, request: operations_pb2.DeleteOperationRequest, context: Any
    ) -> Empty:
        operation_id = names.operation_id(request.name)
        await asyncio.to_thread(self._store.operations.delete, operation_id)
        return Empty()

    async def WaitOperation(
        self, request: operations_pb2.WaitOperationRequest, context: Any
    ) -> operations_pb2.Operation:
        operation_id = names.operation_id(request.name)
        limited = request.HasField("timeout")
        timeout_s = request.timeout.ToTimedelta().total_seconds() if limited else None
        try:
            async with asyncio.timeout(timeout_s):
                async for record in self._changes(operation_id, 0):
                    if record.state.is_final:
                        break
        except TimeoutError:
            record = await self._record(operation_id)
        return await self._encoded(record)

    async def WatchOperation(
        self, request: roel_operations_pb2.WatchOperationRequest, context: Any
    ) -> AsyncIterator[roel_operations_pb2.WatchOperationResponse]:
        operation_id = names.operation_id(request.name)
        async for record in self._changes(operation_id, request.update_seq):
            yield roel_operations_pb2.WatchOperationResponse(
                operation=await self._encoded(record), update_seq=record.update_seq
            )

    async def _changes(self, operation_id: str, update_seq: int) -> AsyncIterator[OperationRecord]:
        """The record now and after each change, the final one last."""
        while True:
            changed = self._scheduler.changes.next()
            record = await self._record(operation_id)
            if record.update_seq > update_seq or record.state.is_final:
                yield record
            if record.state.is_final:
                return
            update_seq = max(update_seq, record.update_seq)
            await changed.wait()
            self._scheduler.check_serving()

    async def _record(self, operation_id: str) -> OperationRecord:
        return await asyncio.to_thread(self._store.operations.get, operation_id)

    async def _encoded(self, record: OperationRecord) -> operations_pb2.Operation:
        return await encoded_operation(self._store, record)


async def submitted(
    store: Store, scheduler: Scheduler, begin: Begin, identity: RequestId | None
) -> operations_pb2.Operation:
    """The operation that was begun, now or by an earlier call with the same request id."""
    # A full queue does not keep anybody from asking again.
    record = await asyncio.to_thread(store.operations.begun, identity)
    if record is None:
        record = await scheduler.submit(begin)
    return await encoded_operation(store, record)


async def encoded_operation(store: Store, record: OperationRecord) -> operations_pb2.Operation:
    """An operation as a message; one that SUCCEEDED answers with the resource that it made."""
    answer = None
    if record.state is OperationState.SUCCEEDED:
        answer = await asyncio.to_thread(_answer, store, record)
    return operation_to_proto(record, answer)


def _answer(store: Store, record: OperationRecord) -> Any:
    """The resource as it is now; None when it is forgotten."""
    with contextlib.suppress(NotFoundError):
        if record.method is OperationMethod.IMPORT_EVENT_STREAM:
            return event_stream_to_proto(store.event_streams.get(record.event_stream_id))
        if record.method is OperationMethod.REFINE_POSES:
            version = store.maps.made_version(record) if record.map_id else None
            return refinement_answer(record, version)
        if record.method in BATCH_ANSWERS:
            return batch_answer(record)
        return map_version_to_proto(store.maps.made_version(record))
    return None
