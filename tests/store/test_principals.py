import sqlite3

import pytest

from roel_service.errors import ConflictError, InputError, NotFoundError, StateError
from roel_service.store.principals import Role
from roel_service.store.store import Store, opened_principals


@pytest.fixture
def principals(store):
    return store.principals


def test_a_token_names_its_principal(principals):
    token = principals.create("robot-1", Role.BUILDER)
    found = principals.of_token(token)
    assert (found.name, found.role) == ("robot-1", Role.BUILDER)
    assert principals.of_token(token + "x") is None


def test_only_a_digest_of_the_token_is_kept(principals, folder):
    token = principals.create("robot-1", Role.READER)
    files = b"".join(path.read_bytes() for path in folder.glob("rows.sqlite*"))
    assert b"robot-1" in files
    assert token.encode() not in files


def test_a_revoked_principal_is_nobody(principals):
    token = principals.create("robot-1", Role.READER)
    principals.revoke("robot-1")
    assert principals.of_token(token) is None
    assert principals.is_empty()
    with pytest.raises(NotFoundError):
        principals.revoke("robot-1")


def test_an_expired_principal_is_nobody(principals):
    token = principals.create("robot-1", Role.READER, expire_time_us=1)
    assert principals.of_token(token) is None
    assert principals.of_names(["robot-1"]) is None
    assert not principals.is_empty()


def test_a_name_of_a_certificate_finds_its_principal(principals):
    principals.create("spiffe://fleet/robot-1", Role.READER)
    assert principals.of_names(["other", "spiffe://fleet/robot-1"]).role is Role.READER
    assert principals.of_names([]) is None


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
        token = beside.create("robot-1", Role.READER)
    assert store.principals.of_token(token).name == "robot-1"


def test_tokens_can_be_made_before_the_first_start(folder):
    with opened_principals(folder) as first:
        token = first.create("robot-1", Role.READER)
    with Store(folder) as store:
        assert store.principals.of_token(token).name == "robot-1"


def test_a_folder_is_not_migrated_under_a_running_server(store, folder):
    with sqlite3.connect(folder / "rows.sqlite") as older:
        older.execute("PRAGMA user_version = 1")
    older.close()
    with pytest.raises(StateError) as caught, opened_principals(folder):
        pass
    assert caught.value.reason == "DATA_IN_USE"
