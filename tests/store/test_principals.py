import sqlite3

import pytest

from roel_service.errors import ConflictError, InputError, NotFoundError, StateError
from roel_service.store.principals import Role, token_sha256
from roel_service.store.store import Store, opened_principals


@pytest.fixture
def principals(store):
    return store.principals


def test_a_token_names_its_principal(principals):
    token = principals.create("robot-1", Role.BUILDER)
    (found,) = principals.list()
    assert (found.name, found.role) == ("robot-1", Role.BUILDER)
    assert found.token_sha256 == token_sha256(token)
    assert token_sha256(token) not in repr(found)


def test_only_a_digest_of_the_token_is_kept(principals, folder):
    token = principals.create("robot-1", Role.READER)
    files = b"".join(path.read_bytes() for path in folder.glob("rows.sqlite*"))
    assert b"robot-1" in files
    assert token.encode() not in files


def test_a_revoked_principal_is_nobody(principals):
    principals.create("robot-1", Role.READER)
    principals.revoke("robot-1")
    assert principals.list() == []
    assert principals.is_empty()
    with pytest.raises(NotFoundError):
        principals.revoke("robot-1")


def test_an_expired_principal_is_nobody(principals):
    principals.create("robot-1", Role.READER, expire_time_us=1)
    principals.create("robot-2", Role.READER, expire_time_us=2**62)
    assert [item.is_current for item in principals.list()] == [False, True]


def test_names_are_taken_once_and_checked(principals):
    principals.create("robot-1", Role.READER)
    with pytest.raises(ConflictError) as conflict:
        principals.create("robot-1", Role.ADMIN)
    with pytest.raises(InputError) as invalid:
        principals.create("two words", Role.ADMIN)
    assert (conflict.value.reason, invalid.value.reason) == ("ALREADY_EXISTS", "ID_INVALID")
    assert [(item.name, item.role) for item in principals.list()] == [("robot-1", Role.READER)]


def test_a_token_made_beside_a_running_server_counts_at_once(store, folder):
    with opened_principals(folder) as beside:
        beside.create("robot-1", Role.READER)
    assert [item.name for item in store.principals.list()] == ["robot-1"]


def test_tokens_can_be_made_before_the_first_start(folder):
    with opened_principals(folder) as first:
        first.create("robot-1", Role.READER)
    with Store(folder) as store:
        assert [item.name for item in store.principals.list()] == ["robot-1"]


def test_a_folder_is_not_migrated_under_a_running_server(store, folder):
    with sqlite3.connect(folder / "rows.sqlite") as older:
        older.execute("PRAGMA user_version = 1")
    older.close()
    with pytest.raises(StateError) as caught, opened_principals(folder):
        pass
    assert caught.value.reason == "DATA_IN_USE"
