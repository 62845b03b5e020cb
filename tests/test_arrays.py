import numpy as np
import pytest

from roel_service.arrays import frozen_array


def test_fitting_array_is_shared_and_only_the_view_is_read_only():
    values = np.arange(3.0)
    frozen = frozen_array(values, np.float64, (3,), "values")
    assert np.shares_memory(frozen, values)
    assert not frozen.flags.writeable
    assert values.flags.writeable


def test_result_is_contiguous_and_of_the_dtype():
    frozen = frozen_array(np.eye(4)[:, ::2], np.float32, (4, None), "values")
    assert frozen.flags.c_contiguous
    assert frozen.dtype == np.float32


@pytest.mark.parametrize("shape", [(2,), (3, None), (None, 3), (2, 3, None), ()])
def test_other_shapes_are_refused_with_the_pattern(shape):
    with pytest.raises(ValueError, match=r"values: expected shape .*, found \(2, 2\)"):
        frozen_array(np.eye(2), np.float64, shape, "values")


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("dtype", [np.float64, np.int32])
def test_values_that_are_not_finite_are_refused(value, dtype):
    with pytest.raises(ValueError, match="values: expected finite"):
        frozen_array([1.0, value], dtype, (2,), "values")


def test_float32_overflow_is_refused():
    with pytest.raises(ValueError, match="values: expected finite"):
        frozen_array([1e300], np.float32, (1,), "values")


@pytest.mark.parametrize(
    ("value", "dtype"),
    [(65536, np.uint16), (-1, np.uint16), (200, np.int8), (0.5, np.int64), (1e19, np.int64)],
)
def test_integers_that_do_not_fit_are_refused_not_wrapped(value, dtype):
    with pytest.raises(ValueError, match="values: expected values that fit"):
        frozen_array(np.array([value]), dtype, (1,), "values")


@pytest.mark.parametrize("values", [[1, 2], [1.0, 2.0], np.array([1, 2], np.uint64), []])
def test_integers_that_fit_may_come_in_any_type(values):
    frozen = frozen_array(values, np.uint16, (None,), "values")
    np.testing.assert_array_equal(frozen, values)
