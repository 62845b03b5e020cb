"""One server: bind, serve, drain."""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import grpc
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from roel_service.errors import InputError, UnavailableError
from roel_service.jobs.executors import ProcessExecutor
from roel_service.jobs.preparation import build_preparation
from roel_service.jobs.scheduler import Policy, Scheduler
from roel_service.jobs.upkeep import upkeep
from roel_service.service.interceptors import ErrorInterceptor
from roel_service.service.services import SERVICES, add_services
from roel_service.service.settings import Settings
from roel_service.store.records import OperationMethod
from roel_service.store.store import Store

logger = logging.getLogger(__name__)

# A client that pings more often than this is told to calm down; ours pings every 20 s.
MIN_PING_INTERVAL_MS = 10_000

DEFAULT_SETTINGS = Settings()


async def serve(
    data: Path,
    host: str,
    port: int,
    *,
    on_ready: Callable[[str], None],
    insecure: bool = False,
    settings: Settings = DEFAULT_SETTINGS,
) -> None:
    """Serve until SIGTERM or SIGINT, then drain.

    Args:
        data: folder of all that the server keeps; created if it does not exist.
        host, port: where to listen; port 0 takes a free one.
        on_ready: called once with `HOST:PORT` when calls are answered.
        insecure: allow a host other than loopback; the protocol is not encrypted yet.

    Raises:
        InputError: a host that is not loopback.
        StateError: another server uses the folder.
        UnavailableError: the port is taken.
    """
    _check_host(host, insecure)
    stop = _stop_at_signals()
    with Store(data) as store:
        scheduler = _scheduler(store, settings)
        await scheduler.start()
        server = grpc.aio.server(
            interceptors=[ErrorInterceptor()], options=_options(settings), compression=None
        )
        add_services(server, store, scheduler, settings)
        health_servicer = await _add_health(server)
        address = _bind(server, host, port)
        await server.start()
        on_ready(address)
        async with upkeep(store, settings.sweep_interval_s):
            await stop.wait()
        logger.info("draining")
        await health_servicer.enter_graceful_shutdown()
        await scheduler.drain()
        await server.stop(settings.drain_grace_s)


def _scheduler(store: Store, settings: Settings) -> Scheduler:
    build = build_preparation(store, settings.build_entrypoint)
    return Scheduler(
        store.operations,
        store.tasks,
        ProcessExecutor(settings.concurrent_builds),
        {OperationMethod.BUILD_MAP: build},
        Policy(
            unfinished_count=settings.concurrent_builds + settings.queued_builds,
            memory_bytes=settings.task_memory_bytes,
            max_memory_bytes=settings.retried_task_memory_bytes,
            time_s=settings.task_time_s,
            retry_delay_s=settings.retry_delay_s,
        ),
    )


def _check_host(host: str, insecure: bool) -> None:
    if not (insecure or host == "localhost" or _is_loopback(host)):
        expected = "a loopback address, since calls are not encrypted (--insecure allows others)"
        raise InputError("--host", expected, host, reason="INSECURE_HOST")


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _stop_at_signals() -> asyncio.Event:
    stop = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    return stop


def _options(settings: Settings) -> list[tuple[str, int]]:
    return [
        ("grpc.max_receive_message_length", settings.message_in_bytes),
        ("grpc.max_send_message_length", settings.message_out_bytes),
        ("grpc.http2.min_recv_ping_interval_without_data_ms", MIN_PING_INTERVAL_MS),
        ("grpc.keepalive_permit_without_calls", 1),
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


def _bind(server: Any, host: str, port: int) -> str:
    """Listen; the address that was bound."""
    shown = f"[{host}]" if ":" in host else host
    try:
        bound = server.add_insecure_port(f"{shown}:{port}")
    except RuntimeError as error:
        found = "one that cannot be listened on"
        raise UnavailableError(f"{shown}:{port}", "a free address", found) from error
    return f"{shown}:{bound}"
