"""`python uploading.py ADDRESS STREAM CHUNK_COUNT`: upload a recording of twelve chunks.

It stops for ever before the chunk of that number, if there is one, and prints the numbers of the
chunks that it sends.
"""

import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from roel_client import Client, client, uploads
from roel_service.scene.events import EventStream
from roel_service.wire.chunks import MAX_CHUNK_EVENT_COUNT

CHUNK_COUNT = 12
EVENT_COUNT = CHUNK_COUNT * MAX_CHUNK_EVENT_COUNT


def recording():
    """All of it; the same in every process."""
    k = np.arange(EVENT_COUNT)
    return EventStream(
        t_us=k,
        x=(k % 64).astype(np.uint16),
        y=(k // 64 % 48).astype(np.uint16),
        polarity=np.where(k % 3, 1, -1).astype(np.int8),
        width=64,
        height=48,
    )


class Stopping:
    """The recording chunk by chunk, up to one."""

    width, height, time_range_us = 64, 48, None

    def __init__(self, chunk_count):
        self._chunk_count = chunk_count

    def chunks(self):
        whole = recording()
        for number in range(CHUNK_COUNT):
            if number == self._chunk_count:
                time.sleep(1000)
            first = number * MAX_CHUNK_EVENT_COUNT
            yield whole.part(first, first + MAX_CHUNK_EVENT_COUNT)


class Told(uploads.EventUpload):
    """An upload that says what it sends."""

    def next_chunk(self):
        chunk = super().next_chunk()
        if chunk is not None:
            sys.stdout.write(f"{chunk.seq}\n")
            sys.stdout.flush()
        return chunk


def main():
    address, stream, chunk_count = sys.argv[1:]
    client.EventUpload = Told
    with Client(address) as connected:
        connected.upload_events(stream, Stopping(int(chunk_count)))


if __name__ == "__main__":
    main()
