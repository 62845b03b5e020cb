from __future__ import annotations

import threading

import pytest

from roel_service.pano_loc.side_by_side import side_by_side


def test_results_come_in_the_order_of_the_items():
    assert side_by_side(lambda item: item * item, range(100)) == [
        item * item for item in range(100)
    ]


def test_nothing_makes_nothing():
    assert side_by_side(str, []) == []


def test_two_items_are_worked_on_at_a_time():
    both = threading.Barrier(2, timeout=10)
    assert sorted(side_by_side(lambda _: both.wait(), range(2))) == [0, 1]


def test_parts_within_parts_end():
    def inner(item: int) -> int:
        return sum(side_by_side(lambda other: item * other, range(4)))

    assert side_by_side(inner, range(8)) == [6 * item for item in range(8)]


def test_an_error_of_either_thread_is_raised_and_nothing_more_is_begun():
    both = threading.Barrier(2, timeout=10)
    begun = []

    def work(item: int) -> None:
        begun.append(item)
        if item < 2:
            both.wait()
            raise ValueError("item")

    with pytest.raises(ValueError, match="item"):
        side_by_side(work, range(1000))
    assert len(begun) < 1000
