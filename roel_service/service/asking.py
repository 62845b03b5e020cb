"""Questions to warm children, on behalf of callers who wait."""

from __future__ import annotations

from typing import Any

from roel_service.errors import UnavailableError
from roel_service.jobs.executors import Executor
from roel_service.jobs.task import Limits, News, TaskSpec
from roel_service.service.settings import Settings

ENTRYPOINT = "roel_service.jobs.desk:Desk"


class Asking:
    """Asks; a caller that goes away takes its question along.

    Args:
        executor: where questions are answered; it bounds how many may wait.
    """

    def __init__(self, executor: Executor, settings: Settings) -> None:
        self._executor = executor
        self._limits = Limits(
            memory_bytes=settings.task_memory_bytes, time_s=settings.interactive_time_s
        )

    async def answer(self, question: Any) -> bytes:
        """The serialized answer to a question.

        Raises:
            RoelError: what answering it raised.
            LimitError: QUEUE_FULL, TASK_OUT_OF_MEMORY, TASK_TIME_LIMIT.
            UnavailableError: WORKER_LOST, twice.
        """
        try:
            return await self._asked(question)
        except UnavailableError:
            # A child that is killed is nobody's fault, and another one is there.
            return await self._asked(question)

    async def _asked(self, question: Any) -> bytes:
        spec = TaskSpec(entrypoint=ENTRYPOINT, parameters=question, limits=self._limits)
        answer: bytes = await self._executor.run(spec, _ignore)
        return answer


async def _ignore(news: News) -> None:
    """Nobody watches a question."""
