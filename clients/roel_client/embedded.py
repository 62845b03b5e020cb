"""The whole server in this process, on a socket that nobody else can reach.

gRPC for Python has no call within a process, so calls go through a Unix-domain socket in a folder of
this user alone: the very same code answers as on a real server, and no port is opened. Builds run in
children as they do there, so a script that embeds a server guards its entry with
`if __name__ == "__main__"`. This module alone of the client imports the server.
"""

from __future__ import annotations

import asyncio
import tempfile
import threading
from collections.abc import AsyncIterator, Iterator
from concurrent.futures import Future
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path


@asynccontextmanager
async def async_served(data: Path) -> AsyncIterator[str]:
    """A server on this loop; its address. Raises as `roel_service.service.server.running`."""
    from roel_service.service.listen import Listen
    from roel_service.service.server import running

    with tempfile.TemporaryDirectory(prefix="roel-") as folder:
        async with running(data, Listen(socket=Path(folder, "socket"))) as addresses:
            yield addresses.calls


@contextmanager
def served(data: Path) -> Iterator[str]:
    """A server on a loop in a thread of its own; its address."""
    started: Future[tuple[str, asyncio.AbstractEventLoop, asyncio.Event]] = Future()
    thread = threading.Thread(target=lambda: asyncio.run(_serve(data, started)))
    thread.start()
    try:
        address, loop, stop = started.result()
    except BaseException:
        thread.join()
        raise
    try:
        yield address
    finally:
        loop.call_soon_threadsafe(stop.set)
        thread.join()


async def _serve(
    data: Path, started: Future[tuple[str, asyncio.AbstractEventLoop, asyncio.Event]]
) -> None:
    """Serve until the event is set; a failure to start is told by the future alone."""
    stop = asyncio.Event()
    try:
        async with async_served(data) as address:
            started.set_result((address, asyncio.get_running_loop(), stop))
            await stop.wait()
    except BaseException as error:
        if started.done():
            raise
        started.set_exception(error)
