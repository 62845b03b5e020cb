import pytest
from hypothesis import given
from hypothesis import strategies as st

from roel_service.errors import InputError, NotFoundError
from roel_service.wire import names

IDS = st.from_regex(names._ID, fullmatch=True)


@given(IDS, st.integers(1, 10**9 - 1))
def test_names_give_back_their_ids(resource_id, version):
    assert names.checked_id(resource_id, "id") == resource_id
    assert names.event_stream_id(names.event_stream_name(resource_id)) == resource_id
    assert names.map_id(names.map_name(resource_id)) == resource_id
    numbered = names.map_version_name(resource_id, version)
    assert names.map_version_id(numbered) == (resource_id, version)
    for alias in (names.LATEST, "live"):
        named = names.map_version_name(resource_id, alias)
        assert names.map_version_id(named) == (resource_id, alias)


@pytest.mark.parametrize(
    "bad", ["", "ab", "Abc", "1abc", "a b c", "a" * 64, "abc/def", "abc\n", "../..", "äbc"]
)
def test_other_ids_are_refused(bad):
    with pytest.raises(InputError) as caught:
        names.checked_id(bad, "map_id")
    assert caught.value.reason == "ID_INVALID"


@pytest.mark.parametrize(
    ("parse", "name"),
    [
        (names.event_stream_id, "projects/default/maps/abc"),
        (names.event_stream_id, "projects/other/eventStreams/abc"),
        (names.event_stream_id, "abc"),
        (names.map_id, "projects/default/maps/../x"),
        (names.map_version_id, "projects/default/maps/abc/versions/v0"),
        (names.map_version_id, "projects/default/maps/abc/versions/Newest"),
        (names.map_version_id, "projects/default/maps/abc"),
        (names.operation_id, "operations/1"),
        (names.operation_id, "operations/" + "g" * 32),
    ],
)
def test_other_names_are_refused(parse, name):
    with pytest.raises(InputError) as caught:
        parse(name)
    assert caught.value.reason == "NAME_INVALID"
    assert name in str(caught.value)


def test_there_is_one_project():
    names.check_parent("projects/default")
    with pytest.raises(NotFoundError):
        names.check_parent("projects/other")


def test_where_an_alias_could_move_a_number_is_needed():
    name = names.map_version_name("house", 12)
    assert names.map_version_number(name) == ("house", 12)
    with pytest.raises(InputError) as caught:
        names.map_version_number(names.map_version_name("house", "live"))
    assert caught.value.reason == "NAME_INVALID"


@pytest.mark.parametrize("alias", ["latest", "v1", "v123", "ab", "Live", ""])
def test_an_alias_is_an_id_but_neither_latest_nor_a_number(alias):
    assert names.checked_alias("live") == "live"
    with pytest.raises(InputError) as caught:
        names.checked_alias(alias)
    assert caught.value.reason == "ID_INVALID"
