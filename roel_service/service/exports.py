"""A map version as a file: the one that is stored, or one that a child writes."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from roel_service.errors import InputError
from roel_service.jobs.executors import Executor
from roel_service.jobs.exports import ExportParameters
from roel_service.jobs.task import Limits, News, TaskSpec
from roel_service.service.settings import Settings
from roel_service.store.records import MapVersionRecord
from roel_service.store.store import Store
from roel_service.v1 import maps_pb2

_SUFFIXES = {
    maps_pb2.MAP_FORMAT_NPZ: "npz",
    maps_pb2.MAP_FORMAT_PLY: "ply",
    maps_pb2.MAP_FORMAT_OBJ: "obj",
    maps_pb2.MAP_FORMAT_JSON: "json",
    maps_pb2.MAP_FORMAT_CSV: "csv",
    maps_pb2.MAP_FORMAT_DXF: "dxf",
}
_STORED = (maps_pb2.MAP_FORMAT_UNSPECIFIED, maps_pb2.MAP_FORMAT_RLM)


class Exporter:
    """Writes versions in other formats.

    Args:
        executor: where that is done; it bounds how much of it.
    """

    def __init__(self, store: Store, executor: Executor, settings: Settings) -> None:
        self._store = store
        self._executor = executor
        self._limits = Limits(
            memory_bytes=settings.task_memory_bytes, time_s=settings.export_time_s
        )

    @asynccontextmanager
    async def file(self, record: MapVersionRecord, format_number: int) -> AsyncIterator[Path]:
        """The version in a format, to be read within the block.

        Raises:
            InputError: an unknown format.
            StateError: MAP_NOT_ACTIVE.
            CorruptionError: the stored file is no longer what was built.
            LimitError: QUEUE_FULL, TASK_OUT_OF_MEMORY.
        """
        stored = await asyncio.to_thread(self._store.maps.map_path, record)
        if format_number in _STORED:
            yield stored
            return
        if format_number not in _SUFFIXES:
            expected = f"one of {', '.join(['rlm', *_SUFFIXES.values()])}"
            raise InputError("format", expected, f"{format_number}")
        with self._store.scratch() as folder:
            target = folder / f"map.{_SUFFIXES[format_number]}"
            parameters = ExportParameters(map_file=stored, target=target)
            entrypoint = "roel_service.jobs.exports:run_export"
            spec = TaskSpec(entrypoint=entrypoint, parameters=parameters, limits=self._limits)
            await self._executor.run(spec, _ignore)
            yield target


async def _ignore(news: News) -> None:
    """Nobody watches an export."""
