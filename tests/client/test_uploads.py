"""Uploads of events as the state machine that they are, against a server that is a list."""

from contextlib import closing

import pytest
from hypothesis import given
from hypothesis import strategies as st

from roel_client.uploads import EventUpload
from roel_service.errors import UnavailableError
from roel_service.progress import ignore
from roel_service.v1 import events_pb2
from roel_service.wire import chunks

from ..service.processes import events_of

EVENTS = events_of(60)
CHUNK_EVENT_COUNT = 10


@pytest.fixture(autouse=True, scope="module")
def small_chunks():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chunks, "MAX_CHUNK_EVENT_COUNT", CHUNK_EVENT_COUNT)
        yield


class Server:
    """Keeps what it acknowledged; notes what it was sent again after that."""

    def __init__(self, credit=3):
        self.credit = credit
        self.durable = []
        self.sent_again = []

    def status(self):
        return events_pb2.AppendStatus(committed_seq=len(self.durable), credit_chunks=self.credit)

    def receive(self, chunk, pending):
        """A chunk of a call; `pending` is what the call has not made durable yet."""
        if chunk.seq < len(self.durable):
            self.sent_again.append(chunk.seq)
        assert chunk.seq == len(self.durable) + len(pending)
        assert len(pending) < self.credit
        pending.append(chunk.data)

    def commit(self, pending):
        self.durable += pending
        pending.clear()
        return self.status()


def call(server, upload, breaks_after):
    """One call; whether it came to its end. It breaks when it has sent so many chunks."""
    pending = []
    upload.restart(server.status())
    while (chunk := upload.next_chunk()) is not None:
        if not upload.has_credit(chunk):
            upload.acknowledge(server.commit(pending))
        if breaks_after == 0:
            return False
        breaks_after -= 1
        server.receive(chunk, pending)
    upload.acknowledge(server.commit(pending))
    return True


def whole():
    return [chunks.encode_chunk(part) for part in chunks.split_chunks(EVENTS)]


@given(st.lists(st.tuples(st.integers(0, 5), st.booleans()), max_size=5), st.integers(1, 4))
def test_what_was_acknowledged_is_never_sent_again(breaks, credit):
    """Calls break after some chunks; the client goes on, or is killed and started anew."""
    server = Server(credit)
    upload = EventUpload(EVENTS, ignore)
    for breaks_after, is_killed in breaks:
        if call(server, upload, breaks_after):
            break
        if is_killed:
            upload.close()
            upload = EventUpload(EVENTS, ignore)
    with closing(upload):
        call(server, upload, breaks_after=1000)
    assert server.durable == whole()
    assert server.sent_again == []


def test_progress_counts_durable_events():
    told = []
    with closing(EventUpload(EVENTS, lambda progress: told.append(progress.done_count))) as upload:
        call(Server(credit=2), upload, breaks_after=1000)
    assert told == [20, 40, 60]


def test_a_call_that_ends_without_a_word_is_to_be_made_again():
    with closing(EventUpload(EVENTS, ignore)) as upload, pytest.raises(UnavailableError):
        upload.restart(None)
