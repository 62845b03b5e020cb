"""LocalizationService: pictures are found in maps."""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import AsyncIterator, Awaitable, Callable
from functools import partial
from typing import Any

from google.longrunning import operations_pb2

from roel_service.errors import InputError, LimitError, RoelError
from roel_service.jobs.asked import Questions, pose_prior
from roel_service.jobs.questions import LocalizeQuestion
from roel_service.service.asking import Asking
from roel_service.service.batches import Batching
from roel_service.service.following import Following
from roel_service.service.settings import Settings
from roel_service.service.uploads import next_request, request_part
from roel_service.v1 import localization_pb2
from roel_service.wire.errors import status_from_error


class LocalizationServicer:
    """Makes questions of requests, and has them answered."""

    def __init__(
        self,
        questions: Questions,
        asking: Asking,
        batching: Batching,
        following: Following,
        settings: Settings,
    ) -> None:
        self._questions = questions
        self._asking = asking
        self._batching = batching
        self._following = following
        self._settings = settings

    async def Localize(
        self, request: localization_pb2.LocalizeRequest, context: Any
    ) -> localization_pb2.LocalizeResponse:
        question = await asyncio.to_thread(self._questions.localization, request)
        answer = await self._asking.answer(question)
        return localization_pb2.LocalizeResponse.FromString(answer)

    async def StreamLocalize(
        self, requests: AsyncIterator[localization_pb2.StreamLocalizeRequest], context: Any
    ) -> AsyncIterator[localization_pb2.StreamLocalizeResponse]:
        search = await self._setup(requests)
        credit = self._settings.stream_credit_pictures
        accepted = localization_pb2.StreamAccepted(
            map_versions=[file.name for file in search.maps], credit_pictures=credit
        )
        yield localization_pb2.StreamLocalizeResponse(accepted=accepted)
        pictures = PictureStream(requests, credit, lambda picture: self._located(search, picture))
        async for answer in pictures.answers():
            yield answer

    async def BatchLocalize(
        self, request: localization_pb2.BatchLocalizeRequest, context: Any
    ) -> operations_pb2.Operation:
        return await self._batching.begin(request)

    async def TrackPoses(
        self, requests: AsyncIterator[localization_pb2.TrackPosesRequest], context: Any
    ) -> AsyncIterator[localization_pb2.TrackPosesResponse]:
        request = await next_request(requests, self._settings)
        if request is None:
            raise InputError("stream", "a message that says where the camera is", "none")
        setup = request_part(request, "setup")
        begins = await asyncio.to_thread(self._questions.tracking, setup)
        listens = partial(context.send_initial_metadata, ())
        async for pose in self._following.poses(begins, requests, listens):
            yield pose

    async def _setup(
        self, requests: AsyncIterator[localization_pb2.StreamLocalizeRequest]
    ) -> LocalizeQuestion:
        request = await anext(requests, None)
        if request is None:
            raise InputError("stream", "a message that says where to look", "none")
        return await asyncio.to_thread(self._questions.search, request_part(request, "setup"))

    async def _located(
        self, search: LocalizeQuestion, picture: localization_pb2.StreamPicture
    ) -> localization_pb2.StreamLocalizeResponse:
        """The answer to one picture, or why there is none."""
        response = localization_pb2.StreamLocalizeResponse(picture_id=picture.picture_id)
        try:
            answer = await self._asking.answer(_question(search, picture))
            response.response.ParseFromString(answer)
        except RoelError as error:
            response.error.CopyFrom(status_from_error(error))
        return response


def _question(
    search: LocalizeQuestion, picture: localization_pb2.StreamPicture
) -> LocalizeQuestion:
    prior = pose_prior(picture.prior) if picture.HasField("prior") else search.prior
    return dataclasses.replace(search, image=picture.image, prior=prior)


class PictureStream:
    """Pictures that arrive while earlier ones are at work; answers come in their order.

    Args:
        requests: what follows the setup.
        credit: pictures that may be unanswered.
        locate: answers one of them.
    """

    def __init__(
        self,
        requests: AsyncIterator[localization_pb2.StreamLocalizeRequest],
        credit: int,
        locate: Callable[[localization_pb2.StreamPicture], Awaitable[Any]],
    ) -> None:
        self._requests = requests
        self._credit = credit
        self._locate = locate
        self._under_way_count = 0
        self._answers: asyncio.Queue[asyncio.Future[Any] | None] = asyncio.Queue()

    async def answers(self) -> AsyncIterator[localization_pb2.StreamLocalizeResponse]:
        """One for each picture; those that are under way end with the caller.

        Raises:
            LimitError: CREDIT_EXCEEDED.
            InputError: UPLOAD_ORDER, something that is no picture.
        """
        receiving = asyncio.create_task(self._receive())
        answering: asyncio.Future[Any] | None = None
        try:
            while (answering := await self._answers.get()) is not None:
                answer = await answering
                # Before the client can see the answer: it may send the next picture at once.
                self._under_way_count -= 1
                yield answer
            receiving.result()
        finally:
            await self._end(receiving, answering)

    async def _receive(self) -> None:
        try:
            async for request in self._requests:
                picture = request_part(request, "picture")
                self._under_way_count += 1
                if self._under_way_count > self._credit:
                    expected = f"at most {self._credit} unanswered pictures"
                    raise LimitError("stream", expected, "one more", reason="CREDIT_EXCEEDED")
                self._answers.put_nowait(asyncio.ensure_future(self._locate(picture)))
        finally:
            self._answers.put_nowait(None)

    async def _end(
        self, receiving: asyncio.Task[None], answering: asyncio.Future[Any] | None
    ) -> None:
        """Be sure that no picture of this stream is at work."""
        receiving.cancel()
        await asyncio.wait({receiving})
        left = [answering] if answering is not None else []
        while not self._answers.empty():
            left += [item for item in [self._answers.get_nowait()] if item is not None]
        for item in left:
            item.cancel()
        if left:
            await asyncio.wait(left)
