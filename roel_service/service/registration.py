"""RegistrationService: maps are laid over clouds and other maps."""

from __future__ import annotations

import asyncio
from typing import Any

from google.longrunning import operations_pb2

from roel_service.jobs.asked import Questions
from roel_service.service.asking import Asking
from roel_service.service.batches import Batching
from roel_service.v1 import registration_pb2


class RegistrationServicer:
    """Makes questions of requests, and has them answered."""

    def __init__(self, questions: Questions, asking: Asking, batching: Batching) -> None:
        self._questions = questions
        self._asking = asking
        self._batching = batching

    async def Register(
        self, request: registration_pb2.RegisterRequest, context: Any
    ) -> registration_pb2.RegisterResponse:
        question = await asyncio.to_thread(self._questions.registration, request)
        answer = await self._asking.answer(question)
        return registration_pb2.RegisterResponse.FromString(answer)

    async def BatchRegister(
        self, request: registration_pb2.BatchRegisterRequest, context: Any
    ) -> operations_pb2.Operation:
        return await self._batching.begin(request)
