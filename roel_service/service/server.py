"""One server: bind, serve, drain."""

from __future__ import annotations

import asyncio
import logging
import signal
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import grpc
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from roel_service.jobs.executors import ProcessExecutor
from roel_service.jobs.preparation import (
    batch_preparation,
    build_preparation,
    event_import_preparation,
    import_preparation,
    refinement_preparation,
)
from roel_service.jobs.scheduler import Policy, Scheduler
from roel_service.jobs.upkeep import upkeep
from roel_service.jobs.warm import WarmExecutor
from roel_service.service.access import Access
from roel_service.service.admin import Probes, admin_server
from roel_service.service.asking import ENTRYPOINT, Asking
from roel_service.service.calls import Guard, GuardInterceptor
from roel_service.service.exports import Exporter
from roel_service.service.following import TRACKING_ENTRYPOINT, Following
from roel_service.service.guards import CallLimits, Drain, FullMethods, told_errors
from roel_service.service.listen import Listen
from roel_service.service.observe import Auditing, Metrics, Observation
from roel_service.service.services import SERVICES, add_services
from roel_service.service.settings import Settings
from roel_service.store.records import OperationMethod
from roel_service.store.store import Store

logger = logging.getLogger(__name__)

# A client that pings more often than this is told to calm down; ours pings every 20 s.
MIN_PING_INTERVAL_MS = 10_000

# Long-lived clients connect anew now and then, so that a balancer in between can spread them.
CONNECTION_AGE_MS = 30 * 60_000
CONNECTION_AGE_GRACE_MS = 10 * 60_000

# After the drain calls only have their last answers to send.
STOP_GRACE_S = 1.0

# Messages are compressed by their own formats, whose sizes are checked; a message that gRPC
# would have to inflate first is refused.
IDENTITY_ONLY = 1

DEFAULT_SETTINGS = Settings()

BATCH_REGISTER = "roel_service.jobs.batches:run_batch_register"
BATCH_LOCALIZE = "roel_service.jobs.batches:run_batch_localize"


@dataclass(frozen=True, kw_only=True)
class Addresses:
    """Where a server answers.

    Attributes:
        calls: `HOST:PORT`, or `unix:PATH`.
        admin: of metrics and probes, if it has them.
    """

    calls: str
    admin: str | None = None


async def serve(
    data: Path,
    listen: Listen,
    *,
    on_ready: Callable[[Addresses], None],
    settings: Settings = DEFAULT_SETTINGS,
) -> None:
    """Serve until SIGTERM or SIGINT, then drain; raises as `running`.

    Args:
        on_ready: called once when calls are answered.
    """
    stop = _stop_at_signals()
    async with running(data, listen, settings) as addresses:
        on_ready(addresses)
        await stop.wait()


@asynccontextmanager
async def running(
    data: Path, listen: Listen, settings: Settings = DEFAULT_SETTINGS
) -> AsyncIterator[Addresses]:
    """A server that drains at the end of the block; where it answers.

    Args:
        data: folder of all that the server keeps; created if it does not exist.

    Raises:
        InputError: INSECURE_HOST, TLS_INVALID.
        StateError: DATA_IN_USE, another server uses the folder; DATA_TOO_NEW.
        UnavailableError: an address is taken.
    """
    credentials = listen.credentials()
    async with AsyncExitStack() as resources:
        store = resources.enter_context(Store(data))
        drain, metrics = Drain(), Metrics(store)
        scheduler = _scheduler(store, settings, metrics)
        await scheduler.start()
        server = grpc.aio.server(
            interceptors=[_interceptor(store, settings, drain, metrics)],
            options=_options(settings),
            compression=None,
        )
        exports = WarmExecutor(settings.concurrent_exports, settings.queued_exports)
        questions = WarmExecutor(
            settings.interactive_workers, settings.interactive_queued, preload=ENTRYPOINT
        )
        cameras = WarmExecutor(
            settings.tracked_cameras, settings.tracked_cameras, preload=TRACKING_ENTRYPOINT
        )
        exporter, asking = Exporter(store, exports, settings), Asking(questions, settings)
        following = Following(cameras, settings)
        add_services(server, store, scheduler, exporter, asking, following, settings)
        health_servicer = await _add_health(server)
        address = listen.bind(server, credentials)
        admin = None
        if listen.admin is not None:
            probes = Probes(metrics=metrics.page, problems=partial(_problems, store, drain))
            admin = await resources.enter_async_context(admin_server(*listen.admin, probes))
        await server.start()
        try:
            async with upkeep(store, settings.sweep_interval_s, settings.longest_upload_s):
                yield Addresses(calls=address, admin=admin)
        finally:
            logger.info("draining")
            await health_servicer.enter_graceful_shutdown()
            drain.begin()
            await scheduler.drain()
            await drain.finish(settings.drain_grace_s)
            await server.stop(STOP_GRACE_S)
            await exports.close()
            await questions.close()
            await cameras.close()


def _scheduler(store: Store, settings: Settings, metrics: Metrics) -> Scheduler:
    batch = partial(
        batch_preparation,
        store,
        cache_bytes=settings.stage_cache_bytes,
        inline_point_count=settings.inline_point_count,
        max_item_bytes=settings.message_in_bytes,
        item_time_s=settings.batch_item_time_s,
    )
    build = build_preparation(
        store,
        settings.build_entrypoint,
        cache_bytes=settings.stage_cache_bytes,
        patience_s=settings.follow_patience_s,
    )
    return Scheduler(
        store.operations,
        store.tasks,
        ProcessExecutor(settings.concurrent_builds),
        {
            OperationMethod.BUILD_MAP: build,
            OperationMethod.IMPORT_MAP: import_preparation(store),
            OperationMethod.IMPORT_EVENT_STREAM: event_import_preparation(
                store, settings.event_stream_bytes
            ),
            OperationMethod.REFINE_POSES: refinement_preparation(store),
            OperationMethod.BATCH_REGISTER: batch(BATCH_REGISTER),
            OperationMethod.BATCH_LOCALIZE: batch(BATCH_LOCALIZE),
        },
        Policy(
            unfinished_count=settings.concurrent_builds + settings.queued_builds,
            memory_bytes=settings.task_memory_bytes,
            max_memory_bytes=settings.retried_task_memory_bytes,
            time_s=settings.task_time_s,
            retry_delay_s=settings.retry_delay_s,
        ),
        metrics.note_end,
    )


def _interceptor(
    store: Store, settings: Settings, drain: Drain, metrics: Metrics
) -> GuardInterceptor:
    """The gate before every call and the guards around it, the outermost first."""
    limits = CallLimits(settings)
    guards: list[Guard] = [
        told_errors,
        Observation(metrics),
        drain,
        # Before anything is looked up: refusing must cost less than answering.
        limits,
        Auditing(store.audit),
        Access(store.principals),
    ]
    return GuardInterceptor(FullMethods(limits, metrics.note_refused), guards)


def _problems(store: Store, drain: Drain) -> list[str]:
    """What keeps the server from working."""
    problems = store.problems()
    return ["draining", *problems] if drain.has_begun else problems


def _stop_at_signals() -> asyncio.Event:
    stop = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    return stop


def _options(settings: Settings) -> list[tuple[str, int]]:
    return [
        ("grpc.max_receive_message_length", settings.message_in_bytes),
        ("grpc.max_send_message_length", settings.message_out_bytes),
        ("grpc.http2.min_ping_interval_without_data_ms", MIN_PING_INTERVAL_MS),
        ("grpc.keepalive_permit_without_calls", 1),
        ("grpc.max_connection_age_ms", CONNECTION_AGE_MS),
        ("grpc.max_connection_age_grace_ms", CONNECTION_AGE_GRACE_MS),
        ("grpc.compression_enabled_algorithms_bitset", IDENTITY_ONLY),
        # What arrives faster than the event loop takes it is dropped before it costs anything: some
        # beyond the first number, all beyond the second.
        ("grpc.server.max_pending_requests", settings.calls_unseen),
        ("grpc.server.max_pending_requests_hard_limit", 2 * settings.calls_unseen),
        # Otherwise a second server shares the port and takes half of the calls.
        ("grpc.so_reuseport", 0),
    ]


async def _add_health(server: Any) -> Any:
    servicer = health.aio.HealthServicer()
    health_pb2_grpc.add_HealthServicer_to_server(servicer, server)
    for service in SERVICES:
        await servicer.set(service, health_pb2.HealthCheckResponse.SERVING)
    served = (*SERVICES, health.SERVICE_NAME, reflection.SERVICE_NAME)
    reflection.enable_server_reflection(served, server)
    return servicer
