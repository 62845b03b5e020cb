import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st

from roel_service.simulate.sensor_kernels import emit

START_US, STOP_US = 1_000.0, 3_000.0
# Rounding of one float64 time of some thousand us after up to 50 steps.
TIME_ATOL_US = 1e-8

thresholds = st.floats(0.05, 0.5)
changes = st.floats(-2.0, 2.0)


def ramp(change, threshold, refractory_us=0.0, reference=0.0, last_us=-np.inf):
    """Events of one pixel whose level moves from 0 to `change`."""
    state = {
        "before": np.zeros((1, 1)),
        "reference": np.full((1, 1), reference),
        "last_us": np.full((1, 1), last_us),
    }
    t_us, _, _, polarity = emit(
        np.full((1, 1), change),
        START_US,
        STOP_US,
        np.full((2, 1, 1), threshold),
        refractory_us,
        state["before"],
        state["reference"],
        state["last_us"],
    )
    return t_us, polarity, state


@given(changes, thresholds)
def test_a_ramp_gives_one_event_for_each_whole_threshold(change, threshold):
    steps = abs(change) / threshold
    assume(abs(steps - round(steps)) > 1e-6)
    t_us, polarity, _ = ramp(change, threshold)
    assert len(t_us) == int(steps)
    assert (polarity == np.sign(change)).all()


@given(changes, thresholds)
def test_events_of_a_ramp_fall_when_the_threshold_is_crossed(change, threshold):
    t_us, _, _ = ramp(change, threshold)
    crossings = np.arange(1, len(t_us) + 1) * threshold / max(abs(change), 1e-300)
    expected = START_US + crossings * (STOP_US - START_US)
    np.testing.assert_allclose(t_us, expected, atol=TIME_ATOL_US)


@given(changes, thresholds, st.floats(1.0, 3_000.0))
def test_a_pixel_is_silent_for_the_refractory_time(change, threshold, refractory_us):
    t_us, _, _ = ramp(change, threshold, refractory_us)
    assert (np.diff(t_us) >= refractory_us).all()
    if abs(change) > threshold * (1 + 1e-9):
        assert len(t_us) >= 1


def test_the_refractory_time_reaches_across_pictures():
    t_us, _, _ = ramp(0.35, 0.1, refractory_us=800.0, last_us=START_US - 100.0)
    # Crossings at 1571, 2143 and 2714 us; the pixel is ready at 1700, and again at 2943.
    np.testing.assert_allclose(t_us, [START_US + 0.2 / 0.35 * 2000.0], atol=TIME_ATOL_US)


@given(st.floats(-2.0, 2.0), thresholds)
def test_the_reference_ends_within_a_threshold_of_the_level(change, threshold):
    _, _, state = ramp(change, threshold)
    assert abs(change - state["reference"][0, 0]) <= threshold * (1 + 1e-9)
    assert state["before"][0, 0] == change


@given(st.floats(0.1, 2.0), thresholds, st.floats(0.1, 0.9))
def test_two_pictures_on_one_ramp_give_the_events_of_the_ramp(change, threshold, share):
    whole, _, _ = ramp(change, threshold)
    middle_us = START_US + share * (STOP_US - START_US)
    before, reference, last_us = np.zeros((1, 1)), np.zeros((1, 1)), np.full((1, 1), -np.inf)
    limits = np.full((2, 1, 1), threshold)
    state = (limits, 0.0, before, reference, last_us)
    first = emit(np.full((1, 1), share * change), START_US, middle_us, *state)[0]
    second = emit(np.full((1, 1), change), middle_us, STOP_US, *state)[0]
    parts = np.concatenate([first, second])
    # The last event may fall on either side of the end by rounding.
    count = min(len(whole), len(parts))
    assert abs(len(whole) - len(parts)) <= 1
    np.testing.assert_allclose(parts[:count], whole[:count], atol=1e-6)


def test_each_polarity_has_its_own_threshold_and_each_pixel_its_place():
    level = np.array([[0.5, -0.5, 0.0]])
    limits = np.stack([np.full((1, 3), 0.3), np.full((1, 3), 0.2)])
    zeros = np.zeros((1, 3))
    t_us, x, y, polarity = emit(
        level, 0.0, 100.0, limits, 0.0, zeros.copy(), zeros.copy(), np.full((1, 3), -np.inf)
    )
    assert x.tolist() == [0, 0, 1]
    assert y.tolist() == [0, 0, 0]
    assert polarity.tolist() == [1, 1, -1]
    np.testing.assert_allclose(t_us, [40.0, 80.0, 60.0], atol=TIME_ATOL_US)
