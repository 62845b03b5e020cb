"""The methods of a service: those that its servicer has, and a refusal for each of the others.

The protocol is ahead of the server. A method becomes implemented when its servicer gets it; nobody
keeps a list.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from types import SimpleNamespace
from typing import Any

from roel_service.errors import UnimplementedError

Behavior = Callable[[Any, Any], Any]


def is_implemented(servicer: object, method: Any) -> bool:
    """Whether a servicer has the method of a descriptor."""
    return hasattr(servicer, method.name)


def complete(service: Any, servicer: object) -> SimpleNamespace:
    """A servicer with every method of the service's descriptor."""
    behaviors = {method.name: _behavior(servicer, method) for method in service.methods}
    return SimpleNamespace(**behaviors)


def method_name(method: Any) -> str:
    """Such as `roel_service.v1.MapService/GetMap`."""
    return f"{method.containing_service.full_name}/{method.name}"


def _behavior(servicer: object, method: Any) -> Behavior:
    if is_implemented(servicer, method):
        behavior: Behavior = getattr(servicer, method.name)
        return behavior
    return _refuse_stream(method) if method.server_streaming else _refuse(method)


def _refuse(method: Any) -> Behavior:
    async def refuse(request: Any, context: Any) -> Any:
        return _refusal(method)

    return refuse


def _refuse_stream(method: Any) -> Behavior:
    async def refuse(request: Any, context: Any) -> AsyncIterator[Any]:
        yield _refusal(method)

    return refuse


def _refusal(method: Any) -> Any:
    expected = "a method of this server"
    raise UnimplementedError(method_name(method), expected, "one of the protocol alone")
