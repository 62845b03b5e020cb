import asyncio
import time

import pytest

from roel_service.errors import ConflictError, EventsError, LimitError, UnavailableError
from roel_service.service.settings import Settings
from roel_service.service.uploads import OpenUploads, Upload
from roel_service.store.event_streams import writer_replaced

# Long enough never to pass in a test.
FOREVER_S = 1000.0
SETTINGS = Settings(commit_interval_s=FOREVER_S, commit_bytes=100, upload_silence_s=FOREVER_S)


class Sink:
    """Takes numbers; each costs 1 and is that many bytes. Notes the groups that are committed."""

    def __init__(self, credit=8, check_s=0.0):
        self.credit = credit
        self.groups = []
        self._check_s = check_s

    def cost(self, request):
        return 1

    def size_bytes(self, item):
        return item

    def check(self, request):
        time.sleep(self._check_s)
        if request < 0:
            raise EventsError("chunk", "a sound one", f"{request}")
        return request

    def commit(self, items):
        self.groups.append(items)
        return sum(len(group) for group in self.groups)


async def requests_of(*items, then=None):
    """Requests at once, then perhaps a wait."""
    for item in items:
        yield item
    if then is not None:
        await then.wait()


def run(sink, *items, settings=SETTINGS, silent=False):
    """Statuses of a call, and the error that it ended with."""

    async def collect():
        then = asyncio.Event() if silent else None
        upload = Upload(requests_of(*items, then=then), sink, settings)
        statuses = []
        try:
            async for status in upload.statuses():
                statuses.append(status)
        except (EventsError, LimitError, UnavailableError) as error:
            return statuses, error.reason
        return statuses, None

    return asyncio.run(collect())


def test_all_items_are_committed_in_order_and_acknowledged():
    sink = Sink()
    statuses, reason = run(sink, *range(7))
    assert reason is None
    assert [item for group in sink.groups for item in group] == list(range(7))
    assert statuses[-1] == 7
    assert statuses == sorted(statuses)


def test_a_group_waits_no_longer_than_its_interval():
    sink = Sink()
    settings = Settings(commit_interval_s=0.01, upload_silence_s=0.2)
    assert run(sink, 1, settings=settings, silent=True) == ([1], "UPLOAD_IDLE")


@pytest.mark.parametrize(
    ("items", "credit"),
    [([60, 60], 8), ([1, 1], 4)],
    ids=["as many bytes as make a group", "half of the credit"],
)
def test_a_group_does_not_wait_for(items, credit):
    sink = Sink(credit=credit)
    settings = Settings(commit_interval_s=FOREVER_S, commit_bytes=100, upload_silence_s=0.2)
    assert run(sink, *items, settings=settings, silent=True) == ([2], "UPLOAD_IDLE")


def test_what_comes_before_a_faulty_item_is_committed():
    sink = Sink()
    statuses, reason = run(sink, 1, 2, -1, 3)
    assert (sink.groups, reason) == ([[1, 2]], "EVENTS_INVALID")
    assert statuses == [2]


def test_nobody_sends_beyond_the_credit():
    sink = Sink(credit=2, check_s=0.05)
    statuses, reason = run(sink, 1, 2, 3)
    assert (statuses[-1], reason) == (2, "CREDIT_EXCEEDED")


def test_silence_ends_a_call():
    settings = Settings(upload_silence_s=0.01)
    assert run(Sink(), settings=settings, silent=True) == ([], "UPLOAD_IDLE")


def entered_uploads(*fences, limit=8):
    """Uploads of one target that came one after another, while all of them last."""

    async def enter():
        uploads = OpenUploads(limit)
        made = [Upload(requests_of(then=asyncio.Event()), Sink(), SETTINGS) for _ in fences]
        contexts = [
            uploads.entered("walk", fence, upload)
            for fence, upload in zip(fences, made, strict=True)
        ]
        for context in contexts:
            context.__enter__()
        with pytest.raises(ConflictError) as caught:
            await anext(made[0].statuses())
        return caught.value.reason

    return asyncio.run(enter())


def test_the_younger_upload_replaces_the_older():
    assert entered_uploads(1, 2) == "WRITER_REPLACED"


def test_the_older_upload_is_refused_when_the_younger_was_faster():
    with pytest.raises(ConflictError) as caught:
        entered_uploads(2, 1)
    assert caught.value.reason == "WRITER_REPLACED"


def test_there_is_room_again_when_an_upload_has_ended():
    uploads = OpenUploads(1)
    with uploads.entered("walk", 1, None):
        with pytest.raises(LimitError) as caught, uploads.entered("run", 1, None):
            pass
        assert caught.value.reason == "TOO_MANY_UPLOADS"
    with uploads.entered("run", 1, None):
        pass


def test_an_upload_that_was_replaced_leaves_the_place_of_the_other():
    ended = []

    class Ending:
        def end(self, error):
            ended.append(error.reason)

    uploads = OpenUploads(1)
    with uploads.entered("walk", 1, Ending()) as _:
        second = uploads.entered("walk", 2, Ending())
        second.__enter__()
    with pytest.raises(LimitError), uploads.entered("run", 1, None):
        pass
    second.__exit__(None, None, None)
    assert ended == [writer_replaced("walk").reason]


def test_an_upload_may_end_after_the_one_that_replaced_it():
    class Ending:
        def end(self, error):
            self.error = error

    uploads = OpenUploads(1)
    with uploads.entered("walk", 1, Ending()), uploads.entered("walk", 2, Ending()):
        pass
    with uploads.entered("run", 1, Ending()):
        pass
