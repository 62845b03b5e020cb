import pytest
from hypothesis import given
from hypothesis import strategies as st

from roel_service.errors import InputError
from roel_service.service.paging import MAX_PAGE_SIZE, page_of, page_request


@given(st.lists(st.text(min_size=1), unique=True, max_size=30), st.integers(1, 10))
def test_following_the_tokens_gives_every_item_once(names, size):
    items = sorted(names)

    def fetch(after, limit):
        return [item for item in items if item > after][:limit]

    found, token = [], ""
    for _ in range(len(items) + 1):
        page = page_of(page_request("things", size, token), fetch, lambda item: item)
        found += page.items
        token = page.next_page_token
        if not token:
            break
    assert found == items


def test_sizes_are_clamped():
    assert page_request("things", 0, "").size == 100
    assert page_request("things", 10**9, "").size == MAX_PAGE_SIZE


@given(st.text(max_size=60))
def test_any_other_token_is_refused(token):
    if token:
        with pytest.raises(InputError) as caught:
            page_request("things", 1, token)
        assert caught.value.reason == "PAGE_TOKEN_INVALID"
