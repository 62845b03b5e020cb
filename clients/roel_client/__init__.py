"""Client of the RoEL map server, and the `roel` command line.

`Client` is loaded when it is first asked for: most commands need no gRPC.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from roel_client.client import Client

__all__ = ["Client"]


def __getattr__(name: str) -> Any:
    if name == "Client":
        from roel_client.client import Client

        return Client
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
