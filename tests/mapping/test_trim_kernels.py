import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from roel_service.mapping.trim_kernels import covered_spans

INTERVALS = st.lists(
    st.tuples(st.integers(0, 20), st.integers(1, 8)).map(lambda pair: (pair[0], sum(pair))),
    min_size=1,
    max_size=12,
)


def spans_by_counting(intervals, fraction):
    """The same on whole numbers: every unit of the axis is counted."""
    units = np.arange(30) + 0.5
    counts = sum(((units > low) & (units < high)).astype(int) for low, high in intervals)
    enough = np.flatnonzero(counts >= max(1.0, fraction * counts.max()))
    return float(enough[0]), float(enough[-1] + 1)


@given(st.lists(INTERVALS, min_size=1, max_size=4), st.sampled_from([0.0, 0.25, 0.5, 1.0]))
def test_spans_are_those_of_counting_every_unit(lines, fraction):
    rows = np.array([pair for line in lines for pair in line], dtype=np.float64)
    offsets = np.concatenate([[0], np.cumsum([len(line) for line in lines])])
    expected = [spans_by_counting(line, fraction) for line in lines]
    np.testing.assert_array_equal(covered_spans(rows, offsets, fraction), expected)


def test_lines_without_an_interval_have_no_span():
    rows = np.array([[0.0, 1.0]])
    spans = covered_spans(rows, np.array([0, 0, 1, 1]), 0.25)
    np.testing.assert_array_equal(spans, [[np.nan] * 2, [0.0, 1.0], [np.nan] * 2])
