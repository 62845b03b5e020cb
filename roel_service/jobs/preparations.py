"""What is prepared from a file once, and used by many calls: in memory, and on disk."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from roel_service.jobs.cache_place import CachePlace
from roel_service.jobs.stage_files import StageFiles
from roel_service.mapping.stage_cache import Arrays

MIB = 2**20


@dataclass(frozen=True, kw_only=True)
class Origin:
    """What a preparation follows from; equal origins, equal preparations.

    Attributes:
        kind: what is prepared, such as `cloud`.
        sha256: of the file.
        parameters: a frozen dataclass.
    """

    kind: str
    sha256: str
    parameters: Any


class Preparation(Protocol):
    """An object in memory that can be kept as arrays."""

    @property
    def size_bytes(self) -> int:
        """Of memory."""

    def to_arrays(self) -> Arrays:
        """What is kept on disk."""


Prepared = TypeVar("Prepared", bound=Preparation)


class Preparations:
    """Those of one process; what was not used for the longest time goes first.

    Args:
        memory_bytes: of all that is kept in memory.
    """

    def __init__(self, memory_bytes: int = 512 * MIB) -> None:
        self._memory_bytes = memory_bytes
        self._kept: OrderedDict[Origin, Any] = OrderedDict()
        self._size_bytes = 0

    def of(
        self,
        origin: Origin,
        prepare: Callable[[], Prepared],
        from_arrays: Callable[[Arrays], Prepared],
        place: CachePlace | None,
    ) -> Prepared:
        """What was prepared before, here or elsewhere; else what `prepare` makes.

        Args:
            from_arrays: the inverse of its `to_arrays`.
            place: where it is kept for other processes; None keeps it for this one alone.
        """
        if origin not in self._kept:
            self._kept[origin] = _prepared(origin, prepare, from_arrays, place)
            self._size_bytes += self._kept[origin].size_bytes
        self._kept.move_to_end(origin)
        found: Prepared = self._kept[origin]
        self._make_room()
        return found

    def _make_room(self) -> None:
        while self._size_bytes > self._memory_bytes:
            _, oldest = self._kept.popitem(last=False)
            self._size_bytes -= oldest.size_bytes


def _prepared(
    origin: Origin,
    prepare: Callable[[], Prepared],
    from_arrays: Callable[[Arrays], Prepared],
    place: CachePlace | None,
) -> Prepared:
    if place is None:
        return prepare()
    files = StageFiles(place.folder, origin.sha256, place.max_bytes)
    arrays = files.get(origin.kind, origin.parameters)
    if arrays is not None:
        return from_arrays(arrays)
    prepared = prepare()
    files.keep(origin.kind, origin.parameters, prepared.to_arrays())
    return prepared
