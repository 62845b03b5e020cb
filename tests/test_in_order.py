import threading

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from roel_service.in_order import in_order


@settings(deadline=None)
@given(st.lists(st.integers(), max_size=30), st.integers(1, 4))
def test_results_come_in_the_order_of_the_items(items, worker_count):
    assert list(in_order(lambda item: 2 * item, items, worker_count)) == [2 * i for i in items]


def test_later_items_may_end_first():
    second_is_done = threading.Event()

    def work(item):
        if item == 0:
            # Ends only after its successor.
            assert second_is_done.wait(timeout=60)
        else:
            second_is_done.set()
        return item

    assert list(in_order(work, [0, 1], 2)) == [0, 1]


@pytest.mark.parametrize("worker_count", [1, 3])
def test_few_items_are_under_way_however_many_there_are(worker_count):
    taken = []

    def endless():
        while True:
            taken.append(len(taken))
            yield taken[-1]

    results = in_order(lambda item: item, endless(), worker_count)
    for done_count in range(1, 50):
        assert next(results) == done_count - 1
        assert len(taken) <= done_count + 2 * worker_count
    results.close()


def threads_of_pools():
    return [t for t in threading.enumerate() if t.name.startswith("ThreadPoolExecutor")]


def test_an_error_of_the_function_comes_in_its_place_and_ends_the_threads():
    def work(item):
        if item == 3:
            raise KeyError(item)
        return item

    results = in_order(work, range(100), 2)
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(KeyError, match="3"):
        next(results)
    assert threads_of_pools() == []


def test_an_error_of_the_items_is_passed_on():
    def items():
        yield 1
        raise OSError("cannot read on")

    with pytest.raises(OSError, match="cannot read on"):
        list(in_order(lambda item: item, items(), 2))
    assert threads_of_pools() == []


def test_a_caller_that_stops_leaves_no_threads_and_begins_nothing_new():
    begun = []
    results = in_order(begun.append, range(1_000), 2)
    next(results)
    results.close()
    assert threads_of_pools() == []
    assert len(begun) <= 1 + 2 * 2


def test_no_items_give_no_results():
    assert list(in_order(lambda item: item, [], 2)) == []
