"""Pages of a list: a bounded size, and a token that fits this list alone."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from roel_service.errors import InputError

DEFAULT_PAGE_SIZE = 100
MAX_PAGE_SIZE = 1000

Item = TypeVar("Item")


@dataclass(frozen=True, kw_only=True)
class PageRequest:
    """Where a page begins and how long it is.

    Attributes:
        scope: names the list and its arguments; a token of another list is refused.
        after: key of the last item of the page before; empty for the first page.
        size: most items.
    """

    scope: str
    after: str
    size: int


@dataclass(frozen=True, kw_only=True)
class Page(Generic[Item]):
    """Items, and the token for the next page; empty on the last."""

    items: Sequence[Item]
    next_page_token: str


def page_request(scope: str, page_size: int, page_token: str) -> PageRequest:
    """Check the fields of a list request; raises `InputError` for a size or token that cannot be."""
    if page_size < 0:
        found = f"{page_size}"
        raise InputError("page_size", "a size of at least 0", found, reason="PAGE_SIZE_INVALID")
    size = min(page_size or DEFAULT_PAGE_SIZE, MAX_PAGE_SIZE)
    after = _key(scope, page_token) if page_token else ""
    return PageRequest(scope=scope, after=after, size=size)


def page_of(
    request: PageRequest,
    fetch: Callable[[str, int], Sequence[Item]],
    key: Callable[[Item], str],
) -> Page[Item]:
    """The page that `fetch(after, limit)` gives; one item more tells whether another follows."""
    items = fetch(request.after, request.size + 1)
    if len(items) <= request.size:
        return Page(items=items, next_page_token="")
    items = items[: request.size]
    return Page(items=items, next_page_token=_token(request.scope, key(items[-1])))


def _token(scope: str, key: str) -> str:
    return base64.urlsafe_b64encode(json.dumps([scope, key]).encode()).decode()


def _key(scope: str, token: str) -> str:
    try:
        token_scope, key = json.loads(base64.urlsafe_b64decode(token.encode()))
    except ValueError:
        token_scope, key = None, None
    if token_scope != scope or not isinstance(key, str):
        expected = "a token of this very list"
        raise InputError("page_token", expected, repr(token[:40]), reason="PAGE_TOKEN_INVALID")
    return key
