"""Metrics and probes over plain HTTP, on an address of their own."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass

from roel_service.errors import UnavailableError
from roel_service.service.metrics import CONTENT_TYPE

logger = logging.getLogger(__name__)

# A request is one line and some headers, which nobody needs.
REQUEST_BYTES = 8192
REQUEST_TIMEOUT_S = 5.0
PLAIN = "text/plain; charset=utf-8"
REASONS = {200: "OK", 404: "Not Found", 405: "Method Not Allowed", 503: "Service Unavailable"}


@dataclass(frozen=True, kw_only=True)
class Page:
    """What is answered."""

    text: str
    status: int = 200
    content_type: str = PLAIN


@dataclass(frozen=True, kw_only=True)
class Probes:
    """What the pages tell; each is called in a thread.

    Attributes:
        metrics: the page of numbers.
        problems: what keeps the server from working, a sentence each; empty when it is ready.
    """

    metrics: Callable[[], str]
    problems: Callable[[], list[str]]


@asynccontextmanager
async def admin_server(host: str, port: int, probes: Probes) -> AsyncIterator[str]:
    """Serve `/metrics`, `/livez` and `/readyz`; the address that was bound.

    Raises:
        UnavailableError: the address is taken.
    """

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            async with asyncio.timeout(REQUEST_TIMEOUT_S):
                head = await reader.readuntil(b"\r\n\r\n")
                writer.write(_encoded(await _page(head, probes)))
                await writer.drain()
        except (TimeoutError, ConnectionError, asyncio.IncompleteReadError) as error:
            logger.debug("admin request given up: %r", error)
        except asyncio.LimitOverrunError:
            logger.debug("admin request too long")
        finally:
            writer.close()

    try:
        server = await asyncio.start_server(answer, host, port, limit=REQUEST_BYTES)
    except OSError as error:
        found = "one that cannot be listened on"
        raise UnavailableError(f"{host}:{port}", "a free address", found) from error
    async with server:
        yield f"{host}:{server.sockets[0].getsockname()[1]}"


async def _page(head: bytes, probes: Probes) -> Page:
    method, _, rest = head.decode("latin-1").partition(" ")
    if method != "GET":
        return Page(text="only GET\n", status=405)
    path = rest.partition(" ")[0].partition("?")[0]
    if path == "/metrics":
        return Page(text=await asyncio.to_thread(probes.metrics), content_type=CONTENT_TYPE)
    if path == "/livez":
        return Page(text="ok\n")
    if path == "/readyz":
        problems = await asyncio.to_thread(probes.problems)
        lines = problems or ["ok"]
        return Page(text="\n".join(lines) + "\n", status=503 if problems else 200)
    return Page(text="/metrics, /livez, /readyz\n", status=404)


def _encoded(page: Page) -> bytes:
    body = page.text.encode()
    head = (
        f"HTTP/1.1 {page.status} {REASONS[page.status]}\r\n"
        f"Content-Type: {page.content_type}\r\n"
        f"Content-Length: {len(body)}\r\n"
        "Connection: close\r\n\r\n"
    )
    return head.encode() + body
