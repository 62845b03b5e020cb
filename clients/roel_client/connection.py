"""A channel to one server, and its failures as the exceptions that were raised there."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import grpc
from google.rpc import status_pb2
from grpc_status import rpc_status

from roel_client.retry import service_config
from roel_service.errors import Cancelled, RoelError
from roel_service.wire.errors import error_from_status

MIB = 2**20

CHANNEL_OPTIONS = (
    ("grpc.service_config", service_config()),
    ("grpc.max_send_message_length", 4 * MIB),
    ("grpc.max_receive_message_length", 8 * MIB),
    # A server that comes back is found soon; by default the pauses grow to two minutes.
    ("grpc.max_reconnect_backoff_ms", 2_000),
    # A dead network is noticed within 30 s, also during an upload or a watch.
    ("grpc.keepalive_time_ms", 20_000),
    ("grpc.keepalive_timeout_ms", 10_000),
    ("grpc.http2.max_pings_without_data", 0),
)

# Single calls are short; this long a server may take to be reached and to answer.
CALL_TIMEOUT_S = 10.0


class Connection:
    """Calls on one server."""

    def __init__(self, address: str) -> None:
        self._address = address
        self.channel = grpc.insecure_channel(address, options=CHANNEL_OPTIONS)

    def close(self) -> None:
        """End all calls."""
        self.channel.close()

    def call(self, method: Any, request: Any, *, timeout_s: float = CALL_TIMEOUT_S) -> Any:
        """The answer of a single call."""
        with self._errors():
            return method(request, timeout=timeout_s)

    def upload(self, method: Any, requests: Iterable[Any]) -> Any:
        """The answer to a stream of requests; what their source raises is raised here."""
        source = _Requests(requests)
        call = method.future(source)
        try:
            with self._errors():
                return call.result()
        finally:
            call.cancel()
            if source.error is not None:
                raise source.error

    def stream(self, method: Any, request: Any) -> Generator[Any, None, None]:
        """The answers of a streaming call; ends the call when the caller stops reading."""
        call = method(request)
        try:
            with self._errors():
                yield from call
        finally:
            call.cancel()

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except grpc.RpcError as error:
            raise self._translated(error) from error

    def _translated(self, error: Any) -> RoelError | Cancelled:
        status = rpc_status.from_call(error)
        if status is None:
            status = status_pb2.Status(code=error.code().value[0], message=error.details())
        return error_from_status(status, subject=self._address)


class _Requests:
    """Requests that gRPC reads in a thread of its own, where an exception would be lost."""

    def __init__(self, requests: Iterable[Any]) -> None:
        self._requests = iter(requests)
        self.error: BaseException | None = None

    def __iter__(self) -> _Requests:
        return self

    def __next__(self) -> Any:
        try:
            return next(self._requests)
        except StopIteration:
            raise
        except BaseException as error:
            self.error = error
            raise StopIteration from error
