"""Parts of one query on both cores: what takes time does not hold the interpreter's lock."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def side_by_side(work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """What work makes of each item, in their order.

    The caller works too, so that it ends even where the second thread is busy with another query.
    """
    waiting = deque(enumerate(items))
    done: dict[int, Result] = {}

    def work_on() -> None:
        while waiting:
            try:
                index, item = waiting.popleft()
            except IndexError:  # the other thread took the last one
                return
            done[index] = work(item)

    helping = _second_thread(os.getpid()).submit(work_on)
    try:
        work_on()
    finally:
        waiting.clear()
        if not helping.cancel():
            helping.result()
    return [done[index] for index in range(len(done))]


@cache  # one in a process: a query has a dozen of such parts, and starting a thread takes milliseconds
def _second_thread(process: int) -> ThreadPoolExecutor:
    """A thread that waits for work; a fork has its own."""
    return ThreadPoolExecutor(1, thread_name_prefix=f"side_by_side-{process}")
