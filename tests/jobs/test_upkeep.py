import asyncio
import os

from roel_service.jobs.upkeep import upkeep
from roel_service.store.store import Store


def test_garbage_goes_by_itself(tmp_path):
    with Store(tmp_path) as store:
        old, new = store._blobs.put(b"old"), store._blobs.put(b"new")
        os.utime(store._blobs.path(old), (0, 0))

        async def scenario():
            async with upkeep(store, interval_s=0.01, unused_for_s=60.0), asyncio.timeout(30):
                while store._blobs.path(old).exists():
                    await asyncio.sleep(0.01)

        asyncio.run(scenario())
        assert store._blobs.path(new).exists()
