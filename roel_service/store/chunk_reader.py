"""Chunks of a recording, one at a time."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

from sqlalchemy import func, select

from roel_service.errors import CorruptionError
from roel_service.store.database import Database
from roel_service.store.schema import EVENT_CHUNK


@dataclass(frozen=True, kw_only=True)
class StoredChunk:
    """A chunk as it was acknowledged."""

    seq: int
    t0_us: int
    t1_us: int
    data: bytes


class ChunkReader:
    """Chunks of one recording, from its open file: it stays readable when the name is gone."""

    def __init__(self, database: Database, uid: str, file: BinaryIO) -> None:
        self._database = database
        self._uid = uid
        self._file = file

    def chunks(self, start_us: int, stop_us: int) -> Iterator[StoredChunk]:
        """Chunks with events start_us <= t < stop_us, in order.

        Raises:
            CorruptionError: bytes are no longer those that were acknowledged.
        """
        for seq in itertools.count(self._first_seq(start_us)):
            chunk = self._chunk(seq)
            if chunk is None or chunk.t0_us >= stop_us:
                return
            if chunk.t1_us >= start_us:
                yield chunk

    def _first_seq(self, start_us: int) -> int:
        """The last chunk that begins before a time; none before that one reaches so far."""
        before = select(func.max(EVENT_CHUNK.c.seq)).where(
            EVENT_CHUNK.c.stream_uid == self._uid, EVENT_CHUNK.c.t0_us < start_us
        )
        with self._database.read() as connection:
            return connection.execute(before).scalar_one() or 0

    def _chunk(self, seq: int) -> StoredChunk | None:
        """One chunk; None behind the last."""
        query = select(EVENT_CHUNK).where(
            EVENT_CHUNK.c.stream_uid == self._uid, EVENT_CHUNK.c.seq == seq
        )
        with self._database.read() as connection:
            row = connection.execute(query).mappings().one_or_none()
        if row is None:
            return None
        self._file.seek(row["offset"])
        data = self._file.read(row["length"])
        found = hashlib.sha256(data).hexdigest()
        if found != row["sha256"]:
            raise CorruptionError(f"chunk {seq}", f"bytes of digest {row['sha256']}", found)
        return StoredChunk(seq=seq, t0_us=row["t0_us"], t1_us=row["t1_us"], data=data)
