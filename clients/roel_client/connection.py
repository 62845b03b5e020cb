"""Calls on one server, with and without asyncio, and their failures as what was raised there.

`AsyncConnection` and `Connection` have the same methods; everything above them is written once.
"""

from __future__ import annotations

import asyncio
import queue
import time
from collections.abc import AsyncGenerator, Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, TypeVar

import grpc
from google.rpc import status_pb2

from roel_client.retry import Attempts, RetryPolicy, identified, is_repeatable
from roel_service.errors import Cancelled, LimitError, RoelError
from roel_service.wire.errors import error_from_status, status_from_error

Result = TypeVar("Result")

MIB = 2**20

# Where gRPC carries a `google.rpc.Status`.
DETAILS_KEY = "grpc-status-details-bin"

CHANNEL_OPTIONS = (
    # Calls are made again by `retry`, which knows request ids and the server's wishes.
    ("grpc.enable_retries", 0),
    ("grpc.max_send_message_length", 4 * MIB),
    ("grpc.max_receive_message_length", 8 * MIB),
    # A server that comes back is found soon; by default the pauses grow from one second to two minutes.
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.max_reconnect_backoff_ms", 2_000),
    # A dead network is noticed within 30 s, also during an upload or a watch.
    ("grpc.keepalive_time_ms", 20_000),
    ("grpc.keepalive_timeout_ms", 10_000),
    ("grpc.http2.max_pings_without_data", 0),
)


@dataclass(frozen=True, kw_only=True)
class Tls:
    """Encryption of a connection; PEM texts.

    Attributes:
        ca_pem: who vouches for the server; None trusts the system's authorities.
        certificate_pem, key_pem: who the client is, for a server that asks.
    """

    ca_pem: bytes | None = None
    certificate_pem: bytes | None = None
    key_pem: bytes | None = field(default=None, repr=False)

    def credentials(self) -> grpc.ChannelCredentials:
        """As gRPC takes them."""
        return grpc.ssl_channel_credentials(self.ca_pem, self.key_pem, self.certificate_pem)


@dataclass(frozen=True, kw_only=True)
class Endpoint:
    """Where a server is and how it is met.

    Attributes:
        address: `HOST:PORT`, or `unix:PATH`.
        token: says who calls.
        tls: None speaks in plain text.
        timeout_s: so long a single call may take, with all its attempts.
        retry: how single calls are repeated.
    """

    address: str
    token: str | None = field(default=None, repr=False)
    tls: Tls | None = None
    timeout_s: float = 10.0
    retry: RetryPolicy = field(default_factory=RetryPolicy)

    @property
    def metadata(self) -> tuple[tuple[str, str], ...]:
        """What goes with every call."""
        return () if self.token is None else (("authorization", f"Bearer {self.token}"),)

    def attempts(self, request: Any, timeout_s: float | None) -> Attempts:
        """For one logical call; gives the request its id."""
        return Attempts(
            self.retry,
            repeatable=is_repeatable(identified(request)),
            timeout_s=self.timeout_s if timeout_s is None else timeout_s,
        )

    @contextmanager
    def errors(self) -> Iterator[None]:
        """Turns what gRPC raises into what the server raised."""
        try:
            yield
        except grpc.RpcError as error:
            raise self._translated(error) from error

    def _translated(self, error: Any) -> RoelError | Cancelled:
        # In asyncio the failure itself has the details, otherwise the call has, which is the failure.
        status = _status_with_details(error)
        if status is None and error.code() is grpc.StatusCode.CANCELLED:
            # Not by us, or it would not be an error: gRPC drops what a busy server has not looked at.
            expected, found = "room for one more call", "a call that was dropped unread"
            status = status_from_error(
                LimitError(self.address, expected, found, reason="QUEUE_FULL")
            )
        if status is None:
            status = status_pb2.Status(code=error.code().value[0], message=error.details())
        return error_from_status(status, subject=self.address)


def _status_with_details(error: Any) -> status_pb2.Status | None:
    for key, value in error.trailing_metadata() or ():
        if key == DETAILS_KEY:
            return status_pb2.Status.FromString(value)
    return None


class AsyncConnection:
    """Calls on one server from an event loop."""

    def __init__(self, endpoint: Endpoint) -> None:
        self._endpoint = endpoint
        self.channel = _channel(grpc.aio, endpoint)

    async def close(self) -> None:
        """End all calls."""
        await self.channel.close()

    async def call(self, method: Any, request: Any, *, timeout_s: float | None = None) -> Any:
        """The answer of a single call, repeated where that is safe."""
        attempts = self._endpoint.attempts(request, timeout_s)
        while True:
            try:
                with self._endpoint.errors():
                    return await method(
                        request,
                        timeout=attempts.remaining_s(),
                        metadata=self._endpoint.metadata,
                    )
            except RoelError as error:
                await asyncio.sleep(attempts.pause_s(error))

    async def upload(self, method: Any, requests: Iterable[Any]) -> Any:
        """The answer to a stream of requests, which are made beside the loop."""
        source = iter(requests)
        call = method(metadata=self._endpoint.metadata)
        try:
            with self._endpoint.errors():
                while (request := await self.run(next, source, None)) is not None:
                    if not await _written(call, request):
                        break
                else:
                    await call.done_writing()
                return await call
        finally:
            call.cancel()

    async def stream(self, method: Any, request: Any) -> AsyncGenerator[Any, None]:
        """The answers of a streaming call; ends the call when the caller stops reading."""
        call = method(request, metadata=self._endpoint.metadata)
        try:
            with self._endpoint.errors():
                async for answer in call:
                    yield answer
        finally:
            call.cancel()

    def exchange(self, method: Any) -> AsyncExchange:
        """A call in which both sides speak; a context manager that ends it."""
        return AsyncExchange(self._endpoint, method)

    async def run(self, work: Callable[..., Result], *arguments: Any) -> Result:
        """Result of work that would hold up the loop."""
        return await asyncio.to_thread(work, *arguments)


class AsyncExchange:
    """A call in which both sides speak."""

    def __init__(self, endpoint: Endpoint, method: Any) -> None:
        self._endpoint = endpoint
        self._call = method(metadata=endpoint.metadata)

    async def __aenter__(self) -> AsyncExchange:
        return self

    async def __aexit__(self, *error: object) -> None:
        self._call.cancel()

    async def send(self, message: Any) -> None:
        """Say something; whether the call has ended is told by `receive`."""
        with self._endpoint.errors():
            await _written(self._call, message)

    async def heard(self) -> None:
        """Wait until the other side listens, or has ended the call, which `receive` tells."""
        with self._endpoint.errors():
            await self._call.initial_metadata()

    async def finish(self) -> None:
        """Say that nothing follows."""
        with self._endpoint.errors():
            await self._call.done_writing()

    async def receive(self) -> Any:
        """The next answer; None when there is none any more."""
        with self._endpoint.errors():
            answer = await self._call.read()
        return None if answer is grpc.aio.EOF else answer


async def _written(call: Any, message: Any) -> bool:
    """Whether the call took the message; False once the server has ended it."""
    try:
        await call.write(message)
    except asyncio.InvalidStateError:
        return False
    return True


class Connection:
    """Calls on one server from any thread."""

    def __init__(self, endpoint: Endpoint) -> None:
        self._endpoint = endpoint
        self.channel = _channel(grpc, endpoint)

    def close(self) -> None:
        """End all calls."""
        self.channel.close()

    def call(self, method: Any, request: Any, *, timeout_s: float | None = None) -> Any:
        """The answer of a single call, repeated where that is safe."""
        attempts = self._endpoint.attempts(request, timeout_s)
        while True:
            try:
                with self._endpoint.errors():
                    return method(
                        request,
                        timeout=attempts.remaining_s(),
                        metadata=self._endpoint.metadata,
                    )
            except RoelError as error:
                time.sleep(attempts.pause_s(error))

    def upload(self, method: Any, requests: Iterable[Any]) -> Any:
        """The answer to a stream of requests; what their source raises is raised here."""
        source = _Requests(requests)
        call = method.future(source, metadata=self._endpoint.metadata)
        try:
            with self._endpoint.errors():
                return call.result()
        finally:
            call.cancel()
            if source.error is not None:
                raise source.error

    def stream(self, method: Any, request: Any) -> Generator[Any, None, None]:
        """The answers of a streaming call; ends the call when the caller stops reading."""
        call = method(request, metadata=self._endpoint.metadata)
        try:
            with self._endpoint.errors():
                yield from call
        finally:
            call.cancel()

    def exchange(self, method: Any) -> Exchange:
        """A call in which both sides speak; a context manager that ends it."""
        return Exchange(self._endpoint, method)

    def run(self, work: Callable[..., Result], *arguments: Any) -> Result:
        """Result of work."""
        return work(*arguments)


class Exchange:
    """A call in which both sides speak."""

    def __init__(self, endpoint: Endpoint, method: Any) -> None:
        self._endpoint = endpoint
        self._messages: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._call = method(iter(self._messages.get, None), metadata=endpoint.metadata)

    def __enter__(self) -> Exchange:
        return self

    def __exit__(self, *error: object) -> None:
        self._call.cancel()
        # gRPC's thread waits for the next message.
        self.finish()

    def send(self, message: Any) -> None:
        """Say something; whether the call has ended is told by `receive`."""
        self._messages.put(message)

    def heard(self) -> None:
        """Wait until the other side listens, or has ended the call, which `receive` tells."""
        with self._endpoint.errors():
            self._call.initial_metadata()

    def finish(self) -> None:
        """Say that nothing follows."""
        self._messages.put(None)

    def receive(self) -> Any:
        """The next answer; None when there is none any more."""
        with self._endpoint.errors():
            return next(self._call, None)


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


def _channel(library: Any, endpoint: Endpoint) -> Any:
    """A channel of `grpc` or `grpc.aio`."""
    if endpoint.tls is None:
        return library.insecure_channel(endpoint.address, options=CHANNEL_OPTIONS)
    credentials = endpoint.tls.credentials()
    return library.secure_channel(endpoint.address, credentials, options=CHANNEL_OPTIONS)
