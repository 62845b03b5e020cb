"""Independent work in threads, results in order."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_order(
    function: Callable[[Item], Result], items: Iterable[Item], worker_count: int
) -> Iterator[Result]:
    """`map(function, items)` in threads, in order.

    Only a few items are under way at a time, so that memory stays bounded for endless `items`.
    An error of `function`, or the caller's end, drops what has not begun.
    """
    iterator = iter(items)
    with ThreadPoolExecutor(worker_count) as pool:
        waiting: list[Future[Result]] = []
        try:
            waiting = [pool.submit(function, item) for item in islice(iterator, 2 * worker_count)]
            while waiting:
                result = waiting.pop(0).result()
                waiting += [pool.submit(function, item) for item in islice(iterator, 1)]
                yield result
        finally:
            for future in waiting:
                future.cancel()
