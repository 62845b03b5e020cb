"""What is prepared from a file once, and used by many calls: in memory, and on disk."""

from __future__ import annotations

import pickle
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from roel_service.jobs.inputs import CachePlace
from roel_service.jobs.stage_files import StageFiles
from roel_service.mapping.stage_cache import Arrays, NoCache, StageCache

MIB = 2**20
Prepared = TypeVar("Prepared")


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


@dataclass(frozen=True)
class Form(Generic[Prepared]):
    """How a preparation is written, and read again."""

    to_arrays: Callable[[Prepared], Arrays]
    from_arrays: Callable[[Arrays], Prepared]


# Only what this program wrote into its own folder, and found unchanged there, is ever unpickled.
PICKLED: Form[Any] = Form(
    lambda value: {"pickle": np.frombuffer(pickle.dumps(value), np.uint8)},
    lambda arrays: pickle.loads(arrays["pickle"].tobytes()),
)


class Preparations:
    """Those of one process; what was not used for the longest time goes first.

    Args:
        memory_bytes: of all that is kept in memory, as it is written.
    """

    def __init__(self, memory_bytes: int = 512 * MIB) -> None:
        self._memory_bytes = memory_bytes
        self._kept: OrderedDict[Origin, tuple[Any, int]] = OrderedDict()

    def of(
        self,
        origin: Origin,
        prepare: Callable[[], Prepared],
        place: CachePlace | None,
        form: Form[Prepared] = PICKLED,
    ) -> Prepared:
        """What was prepared before, here or elsewhere; else what `prepare` makes.

        Args:
            place: where it is kept for other processes; None keeps it for this one alone.
        """
        if origin not in self._kept:
            self._kept[origin] = _prepared(origin, prepare, _files(origin, place), form)
        self._kept.move_to_end(origin)
        found: Prepared = self._kept[origin][0]
        self._make_room()
        return found

    def _make_room(self) -> None:
        while sum(size for _, size in self._kept.values()) > self._memory_bytes:
            self._kept.popitem(last=False)


def _prepared(
    origin: Origin, prepare: Callable[[], Prepared], files: StageCache, form: Form[Prepared]
) -> tuple[Prepared, int]:
    """A preparation and its size, bytes."""
    arrays = files.get(origin.kind, origin.parameters)
    if arrays is not None:
        return form.from_arrays(arrays), _size_bytes(arrays)
    prepared = prepare()
    arrays = form.to_arrays(prepared)
    files.keep(origin.kind, origin.parameters, arrays)
    return prepared, _size_bytes(arrays)


def _files(origin: Origin, place: CachePlace | None) -> StageCache:
    if place is None:
        return NoCache()
    return StageFiles(place.folder, origin.sha256, place.max_bytes)


def _size_bytes(arrays: Arrays) -> int:
    return sum(array.nbytes for array in arrays.values())
