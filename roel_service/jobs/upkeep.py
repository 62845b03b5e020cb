"""What a server does now and then, and in no request: forget and delete."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from roel_service.store.store import Store

logger = logging.getLogger(__name__)


@asynccontextmanager
async def upkeep(store: Store, interval_s: float, unused_for_s: float) -> AsyncIterator[None]:
    """Collect garbage at intervals while the block runs; none is under way when it has ended.

    Args:
        interval_s: between two collections.
        unused_for_s: files that nobody names stay for so long; longer than any upload.
    """
    ended = asyncio.Event()
    sweeping = asyncio.create_task(_sweep_until(ended, store, interval_s, unused_for_s))
    try:
        yield
    finally:
        ended.set()
        await sweeping


async def _sweep_until(
    ended: asyncio.Event, store: Store, interval_s: float, unused_for_s: float
) -> None:
    while not await _is_set_within(ended, interval_s):
        swept = await asyncio.to_thread(store.collect_garbage, unused_for_s)
        logger.info("deleted %d files, kept %d", swept.deleted_blob_count, swept.kept_blob_count)


async def _is_set_within(event: asyncio.Event, seconds: float) -> bool:
    try:
        async with asyncio.timeout(seconds):
            return await event.wait()
    except TimeoutError:
        return False
