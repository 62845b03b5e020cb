import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from roel_service.mapping.line_parts import line_parts


@given(st.lists(st.integers(0, 9), max_size=12), st.integers(1, 6))
def test_parts_are_all_lines_and_rows_in_order(sizes, count):
    offsets = np.cumsum([0, *sizes])
    parts = line_parts(offsets, count)
    assert 1 <= len(parts) <= count
    assert [line for part in parts for line in range(len(sizes))[part.lines]] == [
        *range(len(sizes))
    ]
    assert [row for part in parts for row in range(sum(sizes))[part.rows]] == [*range(sum(sizes))]
    found = np.concatenate([np.diff(part.offsets) for part in parts])
    np.testing.assert_array_equal(found, sizes)


@pytest.mark.parametrize("count", [1, 2, 4])
def test_parts_have_about_as_many_rows(count):
    parts = line_parts(np.arange(0, 401, 4), count)
    assert [part.rows.stop - part.rows.start for part in parts] == [400 // count] * count
