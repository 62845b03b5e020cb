"""Event sources that hand on a stream in pieces, as files and servers do."""

from __future__ import annotations

from collections.abc import Iterator

from roel_service.scene.events import EventStream


class InChunks:
    """A stream in pieces of a given number of events."""

    def __init__(self, stream: EventStream, size: int) -> None:
        self.stream, self.size = stream, size
        self.width, self.height = stream.width, stream.height
        self.time_range_us = stream.time_range_us

    def chunks(self) -> Iterator[EventStream]:
        for start in range(0, len(self.stream), self.size):
            part = self.stream.slice(start, start + self.size, 0)
            yield EventStream(
                t_us=part.t_us,
                x=part.x,
                y=part.y,
                polarity=part.polarity,
                width=self.width,
                height=self.height,
            )
