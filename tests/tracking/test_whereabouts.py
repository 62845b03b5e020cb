import numpy as np
import pytest

from roel_service.geometry.se3 import SE3, rotation_angle, rotation_from_vector
from roel_service.tracking.motion import MotionState
from roel_service.tracking.whereabouts import MAX_COAST_S, Whereabouts

HERE = SE3(
    rotation=rotation_from_vector(np.array([0.3, -0.2, 0.1])), translation=np.array([1.0, 2.0, 3.0])
)
WINDOW_S = 0.025


def moving(velocity, t_us=0):
    return MotionState(
        t_us=t_us, T_world_camera=HERE, velocity=np.array(velocity), covariance=np.eye(12)
    )


def far(one, other):
    """Degrees and metres between two poses."""
    turn_rad = rotation_angle((one.rotation.T @ other.rotation)[None])[0]
    return np.rad2deg(turn_rad), np.linalg.norm(one.translation - other.translation)


def places(whereabouts, t_us, count=200):
    rng = np.random.default_rng(5)
    return [whereabouts.place(t_us, attempt, rng) for attempt in range(count)]


def test_a_camera_that_was_just_lost_is_looked_for_where_it_was():
    whereabouts = Whereabouts(HERE, extent_m=6.0)
    whereabouts.lost(0)
    assert far(whereabouts.place(0, 0, np.random.default_rng(0)), HERE) == pytest.approx((0.0, 0.0))


def test_a_first_pose_is_that_of_the_first_events_whatever_their_clock_says():
    first_us = 1_700_000_000_000_000
    whereabouts = Whereabouts(HERE, extent_m=6.0)
    whereabouts.lost(first_us)
    for place in places(whereabouts, first_us, 20):
        assert far(place, HERE) == pytest.approx((0.0, 0.0), abs=1e-6)


def test_without_events_its_motion_goes_on_for_a_while():
    whereabouts = Whereabouts(HERE, extent_m=6.0)
    whereabouts.relied_on(moving([0.0, 0.0, 0.0, 0.5, 0.0, 0.0]))
    whereabouts.lost(10_000_000)
    place = whereabouts.place(10_000_000, 0, np.random.default_rng(0))
    np.testing.assert_allclose(
        place.translation - HERE.translation, [0.5 * MAX_COAST_S, 0.0, 0.0], atol=1e-12
    )


def test_turns_that_are_seen_are_followed_as_turns_or_as_shifts():
    whereabouts = Whereabouts(HERE, extent_m=6.0)
    whereabouts.lost(0)
    turn_rate = np.array([0.0, 1.0, 0.0])
    for _ in range(12):
        whereabouts.turned(turn_rate, WINDOW_S)
    turned = HERE.rotation @ rotation_from_vector(12 * WINDOW_S * turn_rate)
    only_turned = SE3(rotation=turned, translation=HERE.translation)
    # A camera that goes to the right sees what one does that turns to the right.
    aside = HERE.rotation[:, 0]
    rows = []
    for place in places(whereabouts, 0):
        turn_deg, _ = far(place, only_turned)
        shift_m = (place.translation - HERE.translation) @ aside
        rows.append([turn_deg, shift_m])
    missing_deg, shift_m = np.array(rows).T
    assert missing_deg.min() < 1.0
    assert shift_m.min() >= 0.0
    # What is not turned is shifted: a turn of 0.1 rad is a shift of 0.1 of the distance.
    np.testing.assert_allclose(shift_m, 0.25 * 6.0 * np.deg2rad(missing_deg), rtol=0.05, atol=0.01)


def test_turns_count_only_while_it_is_lost():
    whereabouts = Whereabouts(HERE, extent_m=6.0)
    whereabouts.turned(np.array([0.0, 1.0, 0.0]), 1.0)
    whereabouts.lost(0)
    assert far(whereabouts.place(0, 0, np.random.default_rng(0)), HERE) == pytest.approx((0.0, 0.0))


def test_the_longer_it_is_lost_the_farther_around_is_looked():
    whereabouts = Whereabouts(HERE, extent_m=6.0)
    whereabouts.lost(0)
    soon, late = (
        np.array([far(place, HERE) for place in places(whereabouts, t_us)[2:]]).mean(axis=0)
        for t_us in (200_000, 2_000_000)
    )
    assert (late > 5.0 * soon).all()


def test_a_camera_that_sways_on_its_way_is_expected_where_the_way_leads():
    turn_rate = np.array([0.0, 1.0, 0.0])

    def on_the_way(t_s):
        """A pose on a circle of 2 m, walked at 1 rad/s and 2 m/s."""
        rotation = rotation_from_vector(t_s * turn_rate)
        return SE3(rotation=rotation, translation=2.0 * (rotation @ [0.0, 0.0, 1.0]))

    whereabouts = Whereabouts(on_the_way(0.0), extent_m=6.0)
    for t_s in np.arange(0.0, 0.901, WINDOW_S):
        sways = np.array([0.8, 0.0, 0.0, 0.0, 0.4, 0.0])
        whereabouts.relied_on(
            MotionState(
                t_us=round(1e6 * t_s),
                T_world_camera=on_the_way(t_s),
                velocity=sways,
                covariance=np.eye(12),
            )
        )
    whereabouts.lost(1_700_000)
    turn_deg, shift_m = far(
        whereabouts.place(1_700_000, 0, np.random.default_rng(0)), on_the_way(1.7)
    )
    assert turn_deg < 3.0
    assert shift_m < 0.1
