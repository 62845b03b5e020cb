import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from roel_service.wire.byte_planes import integers_from_planes, planes_from_integers
from roel_service.wire.line_columns import MAX_STEPS, Grid, morton_code, steps_from_morton

steps = st.lists(st.tuples(*[st.integers(0, MAX_STEPS)] * 3), min_size=1, max_size=10).map(np.array)


def test_morton_code_interleaves_x_y_z():
    assert morton_code(np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [2, 0, 0]])).tolist() == [
        1,
        2,
        4,
        8,
    ]
    assert morton_code(np.full((1, 3), MAX_STEPS)).tolist() == [2**63 - 1]


@given(steps)
def test_steps_come_back_from_their_code(values):
    np.testing.assert_array_equal(steps_from_morton(morton_code(values)), values)


@given(st.sampled_from([1, 2, 4, 8]), st.lists(st.integers(0, 2**64 - 1), max_size=10))
def test_integers_come_back_from_their_planes(byte_count, values):
    integers = np.array(values, np.uint64) & np.uint64(2 ** (8 * byte_count) - 1)
    planes = planes_from_integers(integers, byte_count)
    assert planes[: len(values)] == bytes(value % 256 for value in values)
    back = integers_from_planes(np.frombuffer(planes, np.uint8), byte_count)
    np.testing.assert_array_equal(back, integers)


def test_step_is_a_millimetre_unless_the_map_is_tiny_or_huge():
    for extent, step in ((6.0, 6.0 / 2**13), (10.0, 1e-3), (1e4, 1e4 / MAX_STEPS), (0.0, 1e-3)):
        grid = Grid.around(np.zeros(3), np.array([extent, 0.0, 0.0]))
        assert grid.step == step


@given(st.floats(1e-9, 1e12), st.floats(0, 1))
def test_far_corner_is_the_last_step_at_most(extent, share):
    lower, upper = np.full(3, -extent * share), np.full(3, extent * (1 - share))
    grid = Grid.around(lower, upper)
    assert grid.steps(np.stack([lower, upper])).max() <= MAX_STEPS
    # Half a step, and float64 rounding at coordinates of the extent's size.
    error = np.abs(grid.points(grid.steps(upper)) - upper).max()
    assert error <= grid.step / 2 + 4e-16 * extent
