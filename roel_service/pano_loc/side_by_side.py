"""Parts of one query on both cores: what takes time does not hold the interpreter's lock."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

THREAD_COUNT = 2


def side_by_side(work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """What work makes of each item, in their order."""
    with ThreadPoolExecutor(THREAD_COUNT) as threads:
        return list(threads.map(work, items))
