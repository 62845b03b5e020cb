"""A call on its way through the guards, and the interceptor that leads it through them."""

from __future__ import annotations

import asyncio
import uuid
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import AbstractAsyncContextManager, AsyncExitStack
from dataclasses import dataclass, field
from typing import Any

import grpc

from roel_service.store.principals import Principal

# Health and reflection answer for themselves: nothing may hold them up.
OUR_METHODS = ("/roel_service.v1.", "/google.longrunning.")

# What is known of a certificate's owner, the names that a client was given for itself.
CERTIFICATE_NAMES = ("x509_subject_alternative_name", "x509_common_name")

REQUEST_ID_KEY = "x-request-id"
MAX_REQUEST_ID_LENGTH = 64

# Fields by which requests name what they are about, the most particular first.
RESOURCE_FIELDS = ("name", "map_version", "event_stream", "parent")

# Answers that say something about the data, and the field that says it.
VERDICT_FIELDS = {"RegisterResponse": "verdict", "LocalizeResponse": "status"}

Behavior = Callable[[Any, Any], Any]


@dataclass(kw_only=True, eq=False)
class Call:
    """What is known of a call; the guards add to it while it runs.

    Attributes:
        method: `/package.Service/Method`.
        context: gRPC's, to end the call; everything else is read from it before the call begins,
            because gRPC crashes when it is asked about a call that its client has cancelled.
        authorization: what the caller sent under that key.
        certificate_names: for whom the caller's certificate was made.
        peer: the caller's address, as gRPC writes it.
        end_s: the caller's deadline on the loop's clock; None if it has none.
        request_id: names the call in logs and errors; the caller's, if it gave one.
        principal: who calls, once that is known.
        resource: what the request names.
        operation: the long-running operation that the call is about, if any.
        verdict: what an answer says about the data, if it says anything.
        received_bytes, sent_bytes: of messages.
    """

    method: str
    context: Any = None
    authorization: str | None = None
    certificate_names: tuple[str, ...] = ()
    peer: str = ""
    end_s: float | None = None
    request_id: str = field(default_factory=lambda: uuid.uuid4().hex)
    principal: Principal | None = None
    resource: str = ""
    operation: str = ""
    verdict: str = ""
    received_bytes: int = 0
    sent_bytes: int = 0

    def see_request(self, message: Any) -> None:
        """Take note of what the caller sent."""
        self.received_bytes += message.ByteSize()
        if not self.resource:
            self.resource = _resource(message)

    def see_response(self, message: Any) -> None:
        """Take note of what is answered."""
        self.sent_bytes += message.ByteSize()
        kind = message.DESCRIPTOR
        if kind.full_name == "google.longrunning.Operation":
            self.operation = message.name
        elif kind.name in VERDICT_FIELDS:
            field_of = kind.fields_by_name[VERDICT_FIELDS[kind.name]]
            number = getattr(message, field_of.name)
            self.verdict = field_of.enum_type.values_by_number[number].name


# With which status a call of a method is refused before it is looked at; None lets it through.
Gate = Callable[[str], Any]

# Entered before a call and left after it; raises to refuse the call, and sees how the call ended.
Guard = Callable[[Call], AbstractAsyncContextManager[None]]


@grpc.aio.ServerInterceptor.register
class GuardInterceptor:
    """Leads every call of ours through the gate, then through the guards, in their order."""

    def __init__(self, gate: Gate, guards: Sequence[Guard]) -> None:
        self._gate = gate
        self._guards = tuple(guards)
        # Handlers by method, with what leads their calls: made once, not for each call.
        self._led: dict[str, tuple[Any, Any]] = {}

    async def intercept_service(
        self, continuation: Callable[[Any], Awaitable[Any]], details: Any
    ) -> Any:
        """Wrap the handler of one call."""
        handler = await continuation(details)
        if handler is None or not details.method.startswith(OUR_METHODS):
            return handler
        known, led = self._led.get(details.method, (None, None))
        if known is not handler:
            led = self._leading(handler, details.method)
            self._led[details.method] = (handler, led)
        return led

    def _leading(self, handler: Any, method: str) -> Any:
        """The handler with its behavior behind gate and guards."""
        wrap = self._streaming if handler.response_streaming else self._single
        behaviors = {
            name: wrap(behavior, method)
            for name in ("unary_unary", "unary_stream", "stream_unary", "stream_stream")
            if (behavior := getattr(handler, name)) is not None
        }
        return handler._replace(**behaviors)

    def _single(self, behavior: Behavior, method: str) -> Behavior:
        async def guarded(request: Any, context: Any) -> Any:
            if (refusal := self._gate(method)) is not None:
                await context.abort_with_status(refusal)
            call = _call(method, context)
            seen = _seen(request, call)
            async with AsyncExitStack() as entered:
                await self._enter(entered, call)
                response = await behavior(seen, context)
                call.see_response(response)
                return response

        return guarded

    def _streaming(self, behavior: Behavior, method: str) -> Behavior:
        async def guarded(request: Any, context: Any) -> AsyncIterator[Any]:
            if (refusal := self._gate(method)) is not None:
                await context.abort_with_status(refusal)
            call = _call(method, context)
            seen = _seen(request, call)
            async with AsyncExitStack() as entered:
                await self._enter(entered, call)
                async for response in behavior(seen, context):
                    call.see_response(response)
                    yield response

        return guarded

    async def _enter(self, entered: AsyncExitStack, call: Call) -> None:
        for guard in self._guards:
            await entered.enter_async_context(guard(call))


def _call(method: str, context: Any) -> Call:
    metadata = dict(context.invocation_metadata() or ())
    identity = context.auth_context()
    remaining_s = context.time_remaining()
    call = Call(
        method=method,
        context=context,
        authorization=metadata.get("authorization"),
        certificate_names=tuple(
            name.decode(errors="replace")
            for key in CERTIFICATE_NAMES
            for name in identity.get(key, ())
        ),
        peer=context.peer(),
        end_s=None if remaining_s is None else asyncio.get_running_loop().time() + remaining_s,
    )
    given = metadata.get(REQUEST_ID_KEY, "")
    if given and len(given) <= MAX_REQUEST_ID_LENGTH and given.isprintable():
        call.request_id = given
    return call


def _seen(request: Any, call: Call) -> Any:
    """The request, or the requests, as the call takes note of them."""
    if hasattr(request, "__anext__"):
        return _SeenRequests(request, call)
    call.see_request(request)
    return request


class _SeenRequests:
    def __init__(self, requests: AsyncIterator[Any], call: Call) -> None:
        self._requests = requests
        self._call = call

    def __aiter__(self) -> _SeenRequests:
        return self

    async def __anext__(self) -> Any:
        message = await anext(self._requests)
        self._call.see_request(message)
        return message


def _resource(message: Any) -> str:
    fields = message.DESCRIPTOR.fields_by_name
    for name in RESOURCE_FIELDS:
        if name in fields and isinstance(value := getattr(message, name), str) and value:
            return value
    return ""
