"""What is between the pictures of a stream, with answers that the test holds in its hands."""

import asyncio

import pytest

from roel_service.errors import InputError, LimitError
from roel_service.service.localization import PictureStream
from roel_service.v1 import localization_pb2

CREDIT = 2


def picture(picture_id):
    part = localization_pb2.StreamPicture(picture_id=picture_id)
    return localization_pb2.StreamLocalizeRequest(picture=part)


class Camera:
    """Sends pictures when it is told to."""

    def __init__(self):
        self.requests = asyncio.Queue()
        self.begun, self.ended = [], []
        self.may_end = asyncio.Event()

    async def sent(self):
        while (request := await self.requests.get()) is not None:
            yield request

    async def locate(self, part):
        self.begun.append(part.picture_id)
        try:
            # Later pictures are faster.
            await self.may_end.wait()
            await asyncio.sleep(0.01 / part.picture_id)
            return part.picture_id
        finally:
            self.ended.append(part.picture_id)

    def stream(self):
        return PictureStream(self.sent(), CREDIT, self.locate).answers()


async def settled():
    for _ in range(9):
        await asyncio.sleep(0)


def test_pictures_are_at_work_together_and_answered_in_their_order():
    async def main():
        camera = Camera()
        for request in (picture(1), picture(2), None):
            camera.requests.put_nowait(request)
        camera.may_end.set()
        assert [answer async for answer in camera.stream()] == [1, 2]
        assert camera.ended == [2, 1]

    asyncio.run(main())


def test_an_answer_gives_its_credit_back():
    async def main():
        camera, answers = Camera(), []
        camera.may_end.set()
        camera.requests.put_nowait(picture(1))
        async for answer in camera.stream():
            answers.append(answer)
            camera.requests.put_nowait(picture(answer + 1) if answer < 5 else None)
        assert answers == [1, 2, 3, 4, 5]

    asyncio.run(main())


def test_pictures_beyond_the_credit_end_the_stream_after_those_before():
    async def main():
        camera = Camera()
        for picture_id in (1, 2, 3):
            camera.requests.put_nowait(picture(picture_id))
        asyncio.get_running_loop().call_later(0.02, camera.may_end.set)
        stream = camera.stream()
        assert [await anext(stream), await anext(stream)] == [1, 2]
        with pytest.raises(LimitError) as caught:
            await anext(stream)
        assert caught.value.reason == "CREDIT_EXCEEDED"

    asyncio.run(main())


def test_what_is_no_picture_ends_the_stream():
    async def main():
        camera = Camera()
        camera.requests.put_nowait(localization_pb2.StreamLocalizeRequest())
        with pytest.raises(InputError) as caught:
            await anext(camera.stream())
        assert caught.value.reason == "UPLOAD_ORDER"

    asyncio.run(main())


def test_a_caller_who_goes_away_takes_the_pictures_along():
    async def main():
        camera = Camera()
        for picture_id in (1, 2):
            camera.requests.put_nowait(picture(picture_id))
        waiting = asyncio.ensure_future(anext(camera.stream()))
        await settled()
        assert camera.begun == [1, 2]
        waiting.cancel()
        await asyncio.wait({waiting})
        await settled()
        assert sorted(camera.ended) == [1, 2]

    asyncio.run(main())
