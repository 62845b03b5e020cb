import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from roel_service.wire.byte_planes import (
    integers_from_planes,
    largest_of_planes,
    planes_from_integers,
    sum_of_planes,
)


@pytest.mark.parametrize("byte_count", [2, 4])
@given(st.data())
def test_planes_hold_the_integers_their_sum_and_their_largest(byte_count, data):
    dtype = np.dtype(f"u{byte_count}")
    size = st.integers(1, 30)
    values = data.draw(arrays.arrays(dtype, size, elements=st.integers(0, 256**byte_count - 1)))
    planes = np.frombuffer(planes_from_integers(values, byte_count), np.uint8)
    np.testing.assert_array_equal(integers_from_planes(planes, byte_count), values)
    assert sum_of_planes(planes, byte_count) == sum(values.tolist())
    assert largest_of_planes(planes, byte_count) == values.max()
