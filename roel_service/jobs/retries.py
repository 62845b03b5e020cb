"""Which failures get another attempt."""

from __future__ import annotations

import random
from dataclasses import dataclass

from roel_service.errors import LimitError, RoelError, UnavailableError
from roel_service.jobs.faults import FaultError
from roel_service.store.records import TaskRecord

MAX_ATTEMPT_COUNT = 3


@dataclass(frozen=True, kw_only=True)
class Retry:
    """Another attempt.

    Attributes:
        delay_s: to wait before it.
        memory_doublings: of the memory limit, in all.
        failure_hash: of the failure that led to it, if that could come again.
    """

    delay_s: float
    memory_doublings: int
    failure_hash: str = ""


def judge(
    task: TaskRecord, error: RoelError, *, delay_s: float, max_memory_doublings: int
) -> Retry | RoelError:
    """What follows from a failed attempt: another one, or the error that ends the operation.

    A lost worker is nobody's fault. Work that ran out of memory gets twice as much. A bug may come
    from the circumstances, unless it comes twice the same. Any other error is an answer.

    Args:
        task: as it was leased for the attempt.
        error: what the attempt ended with.
        delay_s: mean delay of the second attempt; it doubles with each.
        max_memory_doublings: how often the memory limit may be doubled.
    """
    if isinstance(error, FaultError) and error.fingerprint == task.failure_hash:
        return RoelError(error.subject, error.expected, error.found, reason="POISONED")
    if task.attempt_count >= MAX_ATTEMPT_COUNT:
        return error
    # Jitter: what failed together shall not come back together.
    wait_s = delay_s * 2 ** (task.attempt_count - 1) * random.uniform(0.5, 1.5)
    doublings = task.memory_doublings
    if isinstance(error, FaultError):
        return Retry(delay_s=wait_s, memory_doublings=doublings, failure_hash=error.fingerprint)
    if isinstance(error, UnavailableError):
        return Retry(delay_s=wait_s, memory_doublings=doublings)
    is_short_of_memory = isinstance(error, LimitError) and error.reason == "TASK_OUT_OF_MEMORY"
    if is_short_of_memory and doublings < max_memory_doublings:
        return Retry(delay_s=wait_s, memory_doublings=doublings + 1)
    return error
