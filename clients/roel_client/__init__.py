"""Client of the RoEL map server, and the `roel` command line.

The clients are loaded when they are first asked for: most commands need no gRPC.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from roel_client.aio import AsyncClient
    from roel_client.client import Client
    from roel_client.connection import Tls
    from roel_client.retry import RetryPolicy

__all__ = ["AsyncClient", "Client", "RetryPolicy", "Tls"]

_HOMES = {
    "AsyncClient": "roel_client.aio",
    "Client": "roel_client.client",
    "RetryPolicy": "roel_client.retry",
    "Tls": "roel_client.connection",
}


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
