"""The server as a command."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


def serve(data: Path, listen: dict[str, Any], on_ready: Callable[[dict[str, str]], None]) -> None:
    """Serve until SIGTERM or SIGINT.

    Args:
        listen: fields of `Listen` that differ from its defaults.
        on_ready: is told the `address`, and that of `admin` if there is one.
    """
    from roel_service.service.listen import Listen
    from roel_service.service.server import Addresses, serve

    def tell(addresses: Addresses) -> None:
        admin = {} if addresses.admin is None else {"admin": addresses.admin}
        on_ready({"address": addresses.calls, **admin})

    asyncio.run(serve(data, Listen(**listen), on_ready=tell))


@contextmanager
def log_format(name: str | None) -> Iterator[None]:
    """Write the log in a format that `roel_service.service.logs` names; None leaves it."""
    from roel_service.service.logs import FORMATTERS

    if name is None:
        yield
        return
    handler = logging.StreamHandler()
    handler.setFormatter(FORMATTERS[name]())
    root = logging.getLogger()
    previous = root.handlers
    root.handlers = [handler]
    try:
        yield
    finally:
        root.handlers = previous
