"""What an operator learns of every call: a line in the log, numbers, a row in the audit."""

from __future__ import annotations

import asyncio
import logging
import resource
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from google.rpc import code_pb2

from roel_service.errors import RoelError
from roel_service.service.calls import Call
from roel_service.service.metrics import Counter, Gauge, Histogram, Labels, exposition
from roel_service.service.rules import rule_of
from roel_service.store.audit import Audit
from roel_service.store.records import OperationMethod, OperationRecord, OperationState, now_us
from roel_service.store.store import Store
from roel_service.v1 import operations_pb2
from roel_service.wire.errors import code_of

logger = logging.getLogger(__name__)

# getrusage counts kibibytes, on macOS bytes.
BYTES_PER_MAX_RSS = 1 if sys.platform == "darwin" else 2**10


class Metrics:
    """Every number that the server tells."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self.started = Counter(
            name="roel_rpc_started_total", help="Calls begun.", label_names=("method",)
        )
        self.handled = Counter(
            name="roel_rpc_handled_total", help="Calls ended.", label_names=("method", "code")
        )
        self.seconds = Histogram(
            name="roel_rpc_seconds",
            help="Seconds from a call's begin to its end.",
            label_names=("method", "code"),
        )
        self.received_bytes = Counter(
            name="roel_rpc_received_bytes_total",
            help="Bytes of request messages.",
            label_names=("method",),
        )
        self.sent_bytes = Counter(
            name="roel_rpc_sent_bytes_total",
            help="Bytes of answer messages.",
            label_names=("method",),
        )
        self.ended = Counter(
            name="roel_operations_ended_total",
            help="Long-running operations that ended.",
            label_names=("method", "state"),
        )
        self.attempts = Counter(
            name="roel_operation_attempts_total",
            help="How often the work of operations that ended was begun.",
            label_names=("method",),
        )
        self.cpu_seconds = Counter(
            name="roel_operation_cpu_seconds_total",
            help="Processor seconds of the children of operations that ended.",
            label_names=("method",),
        )
        self.stage_units = Counter(
            name="roel_stage_units_total",
            help="Units of work of stages, by whether an earlier result was found.",
            label_names=("stage", "cached"),
        )
        self.stage_seconds = Histogram(
            name="roel_stage_seconds",
            help="Seconds of the stages of builds that succeeded.",
            label_names=("stage",),
        )
        self.verdicts = Counter(
            name="roel_verdicts_total",
            help="Answers of Register and Localize, by what they say about the data.",
            label_names=("method", "verdict"),
        )
        self._looked_up = (
            Gauge(
                name="roel_operations",
                help="Long-running operations that have not ended, by state.",
                label_names=("state",),
                read=self._operations,
            ),
            Gauge(
                name="roel_oldest_operation_seconds",
                help="Age of the oldest long-running operation that has not ended, by state.",
                label_names=("state",),
                read=self._oldest_operations,
            ),
            Gauge(
                name="roel_process_cpu_seconds_total",
                help="Processor seconds of the server without its children.",
                kind="counter",
                read=lambda: {(): time.process_time()},
            ),
            Gauge(
                name="roel_process_peak_memory_bytes",
                help="Largest resident memory of the server without its children so far.",
                read=_peak_memory,
            ),
        )

    def note_refused(self, method: str, code: str) -> None:
        """Count a call that was refused before it was looked at."""
        self.started.add(method)
        self.handled.add(method, code)

    def note_end(self, record: OperationRecord) -> None:
        """Count an operation that ended."""
        method = record.method.value
        metadata = operations_pb2.OperationMetadata.FromString(record.metadata)
        self.ended.add(method, record.state.value)
        self.attempts.add(method, amount=metadata.attempt_count)
        self.cpu_seconds.add(method, amount=metadata.cpu_s)
        for stage in metadata.stages:
            self.stage_units.add(stage.name, "yes", amount=stage.cached_count)
            self.stage_units.add(stage.name, "no", amount=stage.done_count - stage.cached_count)
        if record.method is OperationMethod.BUILD_MAP and record.state is OperationState.SUCCEEDED:
            version = self._store.maps.version(record.map_id, record.version)
            for name, seconds in version.report["seconds"].items():
                self.stage_seconds.observe(name, value=seconds)

    def page(self) -> str:
        """As Prometheus reads it."""
        counted = (
            self.started,
            self.handled,
            self.seconds,
            self.received_bytes,
            self.sent_bytes,
            self.ended,
            self.attempts,
            self.cpu_seconds,
            self.stage_units,
            self.stage_seconds,
            self.verdicts,
        )
        return exposition((*counted, *self._looked_up))

    def _operations(self) -> dict[Labels, float]:
        counts = dict.fromkeys((OperationState.QUEUED, OperationState.RUNNING), 0)
        for record in self._store.operations.unfinished():
            counts[record.state] += 1
        return {(state.value,): count for state, count in counts.items()}

    def _oldest_operations(self) -> dict[Labels, float]:
        now = now_us()
        oldest_us = dict.fromkeys((OperationState.QUEUED, OperationState.RUNNING), now)
        for record in self._store.operations.unfinished():
            oldest_us[record.state] = min(oldest_us[record.state], record.create_time_us)
        return {(state.value,): (now - time_us) / 1e6 for state, time_us in oldest_us.items()}


def _peak_memory() -> dict[Labels, float]:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return {(): usage.ru_maxrss * BYTES_PER_MAX_RSS}


class Observation:
    """Counts every call and writes it to the log."""

    def __init__(self, metrics: Metrics) -> None:
        self._metrics = metrics

    @asynccontextmanager
    async def __call__(self, call: Call) -> AsyncIterator[None]:
        """Guard one call."""
        start_s = time.perf_counter()
        self._metrics.started.add(call.method)
        code = "OK"
        try:
            yield
        except BaseException as error:
            code = code_name(error)
            raise
        finally:
            self._tell(call, code, time.perf_counter() - start_s)

    def _tell(self, call: Call, code: str, spent_s: float) -> None:
        metrics = self._metrics
        metrics.handled.add(call.method, code)
        metrics.seconds.observe(call.method, code, value=spent_s)
        metrics.received_bytes.add(call.method, amount=call.received_bytes)
        metrics.sent_bytes.add(call.method, amount=call.sent_bytes)
        if call.verdict:
            metrics.verdicts.add(call.method, call.verdict)
        if not logger.isEnabledFor(logging.INFO):
            return
        fields = {
            "request_id": call.request_id,
            "method": call.method,
            "code": code,
            "ms": round(1000 * spent_s, 3),
            "principal": call.principal.name if call.principal else "",
            "peer": call.peer,
            "resource": call.resource,
            "operation": call.operation,
            "received_bytes": call.received_bytes,
            "sent_bytes": call.sent_bytes,
        }
        logger.info(
            "call", extra={"fields": {key: value for key, value in fields.items() if value}}
        )


class Auditing:
    """Leaves a row for every call of somebody known that may change something, refused or not."""

    def __init__(self, audit: Audit) -> None:
        self._audit = audit

    @asynccontextmanager
    async def __call__(self, call: Call) -> AsyncIterator[None]:
        """Guard one call."""
        code = "OK"
        try:
            yield
        except BaseException as error:
            code = code_name(error)
            raise
        finally:
            if rule_of(call.method).audited and call.principal is not None:
                # The row is written also when the call was cancelled just now.
                await asyncio.shield(asyncio.to_thread(self._add, call, code))

    def _add(self, call: Call, code: str) -> None:
        assert call.principal is not None
        self._audit.add(
            principal=call.principal.name, method=call.method, resource=call.resource, code=code
        )


def code_name(error: BaseException) -> str:
    """The gRPC code with which a call ends that raised this."""
    if isinstance(error, RoelError):
        return str(code_pb2.Code.Name(code_of(type(error))))
    return "INTERNAL" if isinstance(error, Exception) else "CANCELLED"
