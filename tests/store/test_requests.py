import sqlite3
from contextlib import closing

import pytest

from roel_service.errors import ConflictError, InputError, NotFoundError
from roel_service.store.requests import RequestId
from roel_service.store.store import Store

from .samples import CAMERA, LIMIT_BYTES, chunk


def request(number=1, content="a"):
    return RequestId(id=f"00000000-0000-4000-8000-{number:012}", content_sha256=content)


def test_the_same_request_has_the_result_of_the_first(store):
    first = store.maps.create("house", display_name="House", request=request())
    store.maps.update("house", {"display_name": "Home"}, first.etag, None)
    assert store.maps.create("house", display_name="House", request=request()) == first
    assert store.maps.get("house").display_name == "Home"


def test_a_repeated_change_changes_nothing(store):
    store.maps.create("house")
    first = store.maps.update("house", {"display_name": "Home"}, "", request())
    assert store.maps.update("house", {"display_name": "Home"}, "", request()) == first
    assert store.maps.get("house").revision == first.revision


def test_other_content_under_a_known_id_is_refused(store):
    store.maps.create("house", request=request())
    with pytest.raises(InputError) as caught:
        store.maps.create("attic", request=request(content="b"))
    assert caught.value.reason == "REQUEST_ID_REUSED"
    with pytest.raises(NotFoundError):
        store.maps.get("attic")


def test_a_request_that_failed_is_not_remembered(store):
    with pytest.raises(NotFoundError):
        store.maps.update("house", {"display_name": "Home"}, "", request())
    store.maps.create("house")
    assert store.maps.update("house", {"display_name": "Home"}, "", request()).display_name


def test_requests_are_remembered_by_the_next_server(folder):
    with Store(folder) as store:
        first = store.maps.create("house", request=request())
    with Store(folder) as store:
        assert store.maps.create("house", request=request()) == first


def test_requests_of_long_ago_are_forgotten(store, folder):
    store.maps.create("house", request=request())
    with closing(sqlite3.connect(folder / "rows.sqlite")) as connection, connection:
        connection.execute("UPDATE request SET expire_time_us = 1")
    assert store.maps.create("attic", request=request(content="b")).id == "attic"


def test_a_recording_is_opened_frozen_and_deleted_once(store):
    streams = store.event_streams
    opened = streams.create("walk", CAMERA, request(1))
    assert streams.create("walk", CAMERA, request(1)) == opened
    streams.append_chunks("walk", streams.take_over("walk").fence, [chunk(0)], LIMIT_BYTES)
    sealed = streams.finalize("walk", request=request(2))
    assert streams.finalize("walk", request=request(2)) == sealed
    streams.delete("walk", sealed.etag, request(3))
    streams.delete("walk", sealed.etag, request(3))
    assert streams.finalize("walk", request=request(2)) == sealed
    with pytest.raises(NotFoundError):
        streams.get("walk")
    with pytest.raises(InputError) as caught:
        streams.delete("walk", "", request(3, content="b"))
    assert caught.value.reason == "REQUEST_ID_REUSED"


def test_a_recording_that_has_grown_has_another_etag(store):
    streams = store.event_streams
    opened = streams.create("walk", CAMERA)
    streams.append_chunks("walk", streams.take_over("walk").fence, [chunk(0)], LIMIT_BYTES)
    for change in (streams.finalize, streams.delete):
        with pytest.raises(ConflictError) as caught:
            change("walk", opened.etag)
        assert caught.value.reason == "ETAG_MISMATCH"
    assert streams.finalize("walk", streams.get("walk").etag).digest
