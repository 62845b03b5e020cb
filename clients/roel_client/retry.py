"""When a call is made again: only where that is safe, and as the server asks for.

A call may be repeated when it only looks, when its second time changes nothing, or when it carries
a request id, by which the server knows it again. It is repeated when the server was unavailable,
and when it was busy and said how long to wait.
"""

from __future__ import annotations

import random
import time
import uuid
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

from roel_service.errors import LimitError, RoelError, UnavailableError

Request = TypeVar("Request")

# How the names of methods begin, and so of their requests, that are harmless to repeat.
HARMLESS_VERBS = (
    "Get",
    "List",
    "Query",
    "Find",
    "Read",
    "Wait",
    "Watch",
    "Export",
    "Sync",
    "Register",
    "Localize",
    "Cancel",
    "Finalize",
)

_jitter = random.SystemRandom()


@dataclass(frozen=True, kw_only=True)
class RetryPolicy:
    """How often and how fast.

    Attributes:
        attempt_count: calls in all.
        first_pause_s: the pause before the second call; each further one is twice as long.
        longest_pause_s: no pause of ours is longer; the server may ask for more.
    """

    attempt_count: int = 4
    first_pause_s: float = 0.2
    longest_pause_s: float = 4.0


# Uploads and watches are taken up again where they broke. A machine that boots is back within the
# minute that these pauses make; what was acknowledged begins them anew.
RESUMING = RetryPolicy(attempt_count=20)
NO_RETRY = RetryPolicy(attempt_count=1)


class Attempts:
    """The attempts of one logical call.

    Args:
        repeatable: whether the call may be made twice at all.
        timeout_s: for all attempts and pauses together; None sets no limit.
    """

    def __init__(
        self,
        policy: RetryPolicy,
        *,
        repeatable: bool = True,
        timeout_s: float | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._policy = policy
        self._left_count = policy.attempt_count - 1 if repeatable else 0
        self._pause_s = policy.first_pause_s
        self._clock = clock
        self._end_s = None if timeout_s is None else clock() + timeout_s

    def remaining_s(self) -> float | None:
        """What is left of the timeout, for the next attempt."""
        return None if self._end_s is None else max(0.0, self._end_s - self._clock())

    def pause_s(self, error: RoelError) -> float:
        """How long to wait before the next attempt.

        Raises:
            RoelError: the error itself, when it is to be the last word.
        """
        pause_s = self._pause_s * _jitter.uniform(0.5, 1.0)
        if error.retry_after_s is not None:
            pause_s = max(pause_s, error.retry_after_s)
        remaining_s = self.remaining_s()
        too_late = remaining_s is not None and pause_s >= remaining_s
        if self._left_count == 0 or too_late or not may_pass(error):
            raise error
        self._left_count -= 1
        self._pause_s = min(2 * self._pause_s, self._policy.longest_pause_s)
        return pause_s


def may_pass(error: RoelError) -> bool:
    """Whether the same call may succeed later: the server was away, or said how long it is busy."""
    busy = isinstance(error, LimitError) and error.retry_after_s is not None
    return busy or isinstance(error, UnavailableError)


def identified(request: Request) -> Request:
    """The request with an id, if it can have one: made once for all attempts of a call."""
    message: Any = request
    if "request_id" in message.DESCRIPTOR.fields_by_name and not message.request_id:
        message.request_id = str(uuid.uuid4())
    return request


def is_repeatable(request: Any) -> bool:
    """Whether a second call changes nothing that the first one has not changed."""
    if request.DESCRIPTOR.name.startswith(HARMLESS_VERBS):
        return True
    return "request_id" in request.DESCRIPTOR.fields_by_name and bool(request.request_id)
