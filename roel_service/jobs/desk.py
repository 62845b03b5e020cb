"""Where questions are answered: entry point of warm children, and what batches ask."""

from __future__ import annotations

from typing import Any

from roel_service.jobs import localization, registration
from roel_service.jobs.preparations import Preparations
from roel_service.jobs.questions import Question, RegisterQuestion
from roel_service.jobs.task import Tell


class Desk:
    """Keeps what it prepared for the next question."""

    def __init__(self) -> None:
        self._preparations = Preparations()

    def __call__(self, question: Question, tell: Tell) -> bytes:
        """The serialized answer."""
        return bytes(self.answer(question).SerializeToString())

    def answer(self, question: Question) -> Any:
        """The answer, as a message."""
        if isinstance(question, RegisterQuestion):
            return registration.answer(question, self._preparations)
        return localization.answer(question, self._preparations)
