"""The one place where exceptions become statuses."""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

import grpc
from grpc_status import rpc_status

from roel_service.errors import RoelError
from roel_service.jobs.faults import logged_fault
from roel_service.wire.errors import status_from_error

# Health and reflection answer for themselves.
OUR_METHODS = ("/roel_service.v1.", "/google.longrunning.")

Behavior = Callable[[Any, Any], Any]


@grpc.aio.ServerInterceptor.register
class ErrorInterceptor:
    """Ends a failed call with a `google.rpc.Status`; nobody else aborts.

    A `RoelError` is told with all its details. Anything else is a bug: it is logged with an id,
    and the caller learns the id alone.
    """

    async def intercept_service(
        self, continuation: Callable[[Any], Awaitable[Any]], details: Any
    ) -> Any:
        """Wrap the handler of one call."""
        handler = await continuation(details)
        if handler is None or not details.method.startswith(OUR_METHODS):
            return handler
        wrap = _wrap_stream if handler.response_streaming else _wrap_unary
        behaviors = {
            name: wrap(behavior, details.method)
            for name in ("unary_unary", "unary_stream", "stream_unary", "stream_stream")
            if (behavior := getattr(handler, name)) is not None
        }
        return handler._replace(**behaviors)


def _wrap_unary(behavior: Behavior, method: str) -> Behavior:
    async def wrapped(request: Any, context: Any) -> Any:
        try:
            return await behavior(request, context)
        except RoelError as error:
            await _abort(context, error)
        except Exception as error:  # the border of the server: whatever is left is a bug
            await _abort(context, logged_fault(error, method))

    return wrapped


def _wrap_stream(behavior: Behavior, method: str) -> Behavior:
    async def wrapped(request: Any, context: Any) -> AsyncIterator[Any]:
        try:
            async for response in behavior(request, context):
                yield response
        except RoelError as error:
            await _abort(context, error)
        except Exception as error:  # the border of the server: whatever is left is a bug
            await _abort(context, logged_fault(error, method))

    return wrapped


async def _abort(context: Any, error: RoelError) -> None:
    await context.abort_with_status(rpc_status.to_status(status_from_error(error)))
