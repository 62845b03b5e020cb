from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from roel_service.errors import EventsError
from roel_service.scene.events import EventStream, concatenate

WIDTH, HEIGHT = 12, 8


def stream(t_us, **columns):
    count = len(t_us)
    values = {
        "x": np.arange(count) % WIDTH,
        "y": np.arange(count) % HEIGHT,
        "polarity": np.where(np.arange(count) % 2, 1, -1),
        "width": WIDTH,
        "height": HEIGHT,
    }
    return EventStream(t_us=np.asarray(t_us, np.int64), **(values | columns))


times = st.lists(st.integers(0, 1000), max_size=40).map(sorted)


@given(times, st.lists(st.integers(-10, 1010), min_size=1, max_size=6).map(sorted))
def test_slices_between_cuts_partition_the_stream(t_us, cuts_us):
    events = stream(t_us)
    edges_us = [-11, *cuts_us, 1011]
    parts = [events.between(start, stop) for start, stop in pairwise(edges_us)]
    for column in ("t_us", "x", "y", "polarity"):
        joined = np.concatenate([getattr(part, column) for part in parts])
        np.testing.assert_array_equal(joined, getattr(events, column))


@given(times, st.integers(0, 1000), st.integers(0, 200))
def test_window_around_a_time_is_half_open(t_us, centre_us, half_us):
    window = stream(t_us).around(centre_us, half_us)
    expected = [t for t in t_us if centre_us - half_us <= t < centre_us + half_us]
    np.testing.assert_array_equal(window.t_us, expected)
    assert window.t_ref_us == centre_us


@given(times, st.integers(0, 10), st.integers(0, 1001))
def test_last_events_end_before_the_time(t_us, count, before_us):
    window = stream(t_us).last(count, before_us)
    earlier = [t for t in t_us if t < before_us]
    np.testing.assert_array_equal(window.t_us, earlier[max(0, len(earlier) - count) :])


def test_slices_share_memory_with_the_stream():
    events = stream([1, 2, 3, 4])
    window = events.between(2, 4)
    assert np.shares_memory(window.t_us, events.t_us)
    assert np.shares_memory(window.x, events.x)


def test_space_time_points_count_time_from_the_reference_in_scaled_milliseconds():
    window = stream([1_000, 2_500, 4_000]).slice(0, 3, t_ref_us=2_000)
    expected = [[0, 0, -20.0], [1, 1, 10.0], [2, 2, 40.0]]
    np.testing.assert_allclose(window.xyt(20.0), expected, rtol=1e-15)


def test_single_microseconds_survive_late_in_a_recording():
    day_us = 24 * 3600 * 1_000_000
    window = stream([day_us, day_us + 1]).slice(0, 2, t_ref_us=day_us)
    np.testing.assert_allclose(np.diff(window.xyt(1.0)[:, 2]), 1e-3, rtol=1e-12)


def test_stream_without_events_is_sound():
    events = stream([])
    assert len(events) == 0
    assert len(events.around(0, 100)) == 0
    assert events.between(0, 10).xyt(20.0).shape == (0, 3)


def test_columns_have_the_declared_types_and_are_read_only():
    events = stream([0, 1])
    types = [events.t_us.dtype, events.x.dtype, events.y.dtype, events.polarity.dtype]
    assert types == [np.int64, np.uint16, np.uint16, np.int8]
    with pytest.raises(ValueError, match="read-only"):
        events.x[0] = 3


def test_equal_times_are_allowed_and_decreasing_ones_are_named_by_index():
    assert len(stream([5, 5, 5])) == 3
    with pytest.raises(EventsError, match="a decrease at event 2") as caught:
        stream([5, 6, 5])
    assert caught.value.reason == "EVENT_TIME_NOT_MONOTONE"


@pytest.mark.parametrize(("column", "value"), [("x", WIDTH), ("y", HEIGHT), ("x", 65535)])
def test_events_outside_the_sensor_are_named_by_index(column, value):
    with pytest.raises(EventsError, match=rf"{column} = {value} at event 1") as caught:
        stream([0, 1, 2], **{column: np.array([0, value, 0])})
    assert caught.value.reason == "EVENT_OUT_OF_BOUNDS"


@pytest.mark.parametrize("value", [0, 2, -2])
def test_polarity_is_a_sign(value):
    with pytest.raises(EventsError, match=rf"found {value} at event 2") as caught:
        stream([0, 1, 2], polarity=np.array([1, -1, value]))
    assert caught.value.reason == "EVENT_POLARITY_INVALID"


@pytest.mark.parametrize(
    ("column", "value"), [("x", 65536 + 5), ("y", -1), ("x", 0.5), ("polarity", 257)]
)
def test_values_that_do_not_fit_their_column_are_refused_not_wrapped(column, value):
    with pytest.raises(ValueError, match=f"{column}: expected values that fit"):
        stream([0, 1, 2], **{column: np.array([1, value, 1])})


@pytest.mark.parametrize("column", ["x", "y", "polarity"])
def test_columns_of_other_lengths_are_refused(column):
    with pytest.raises(ValueError, match=column):
        stream([0, 1, 2], **{column: np.ones(2)})


@given(times, st.integers(0, 40))
def test_concatenating_chunks_gives_the_stream_back(t_us, cut):
    events = stream(t_us)
    cut = min(cut, len(events))
    chunks = [
        stream(
            events.t_us[part], x=events.x[part], y=events.y[part], polarity=events.polarity[part]
        )
        for part in (slice(0, cut), slice(cut, None))
    ]
    joined = concatenate(chunks)
    for column in ("t_us", "x", "y", "polarity"):
        np.testing.assert_array_equal(getattr(joined, column), getattr(events, column))
    assert list(events.chunks()) == [events]


def test_chunks_out_of_order_are_refused():
    with pytest.raises(EventsError, match="a decrease at event 2"):
        concatenate([stream([10, 11]), stream([9])])


def test_chunks_after_an_empty_one_are_in_order_too():
    with pytest.raises(EventsError, match="a decrease at event 2"):
        concatenate([stream([10, 11]), stream([]), stream([9])])


def test_chunks_of_another_sensor_are_refused():
    events = stream([1])
    wider = EventStream(
        t_us=[2], x=[0], y=[0], polarity=[1], width=events.width + 1, height=events.height
    )
    with pytest.raises(EventsError, match=f"a sensor of {events.width}x{events.height}") as refusal:
        concatenate([events, wider])
    assert refusal.value.reason == "SENSOR_MISMATCH"


def test_concatenated_columns_are_read_only():
    joined = concatenate([stream([1]), stream([2])])
    with pytest.raises(ValueError, match="read-only"):
        joined.t_us[0] = 5
