from dataclasses import replace

import numpy as np

from roel_service.config.stages import TrackConfig
from roel_service.geometry.se3 import SE3
from roel_service.tracking.fit import Evidence, WindowFit, fit_window
from roel_service.tracking.follower import (
    EXPECTED_SURPRISE,
    MAX_FOLLOWER_COUNT,
    Follower,
    cautious_covariance,
    rivals,
)
from roel_service.tracking.locate import EVENT_SCALES_PX, roughly_at
from roel_service.tracking.motion import MotionState

from .synthetic import WINDOW_US, eyes_on, recording, window_at

CONFIG = TrackConfig()


def follower(x_m, explained_count):
    fit = WindowFit(
        state=MotionState(
            t_us=0,
            T_world_camera=SE3(rotation=np.eye(3), translation=np.array([x_m, 0.0, 0.0])),
            velocity=np.zeros(6),
            covariance=np.eye(12),
        ),
        surprise=0.0,
        evidence=Evidence(
            on_count=explained_count,
            beside_count=10,
            in_view_px=100.0,
            moving_px=100.0,
            seen_px=100.0,
            moving_px2=500.0,
            seen_px2=500.0,
            seen_count=10,
        ),
        seen=np.ones(10, np.bool_),
        information=np.eye(12),
        information_of_edges=np.zeros((0, 12, 12)),
    )
    return Follower(fit)


def test_answers_that_explain_much_less_are_no_rivals():
    best, near, poor = follower(0.0, 1000), follower(0.1, 950), follower(0.2, 700)
    assert rivals([poor, near, best]) == [best, near]


def test_the_same_answer_twice_is_no_rival():
    best, same = follower(0.0, 1000), follower(0.001, 990)
    assert rivals([same, best]) == [best]


def test_only_so_many_are_followed():
    many = [follower(0.1 * k, 1000 - k) for k in range(6)]
    assert rivals(many) == many[:MAX_FOLLOWER_COUNT]


def test_what_explains_lacks_the_lines_that_should_have_events():
    evidence = follower(0.0, 1000).fit.evidence
    assert evidence.explained_count == 1000
    assert replace(evidence, seen_px2=250.0).explained_count == 500
    assert replace(evidence, moving_px2=0.0, seen_px2=0.0).explained_count == 0.0


def test_a_direction_that_one_edge_holds_alone_is_open():
    edges = np.zeros((3, 12, 12))
    edges[:, 3, 3] = 1e6
    edges[0, 5, 5] = 1e6
    fit = replace(follower(0.0, 1).fit, information=edges.sum(axis=0), information_of_edges=edges)
    forecast = np.diag(np.square([0.1] * 12))
    sigma_m = np.sqrt(np.diagonal(cautious_covariance(forecast, fit))[3:6])
    # Three edges hold x; one holds z, and without it nothing is known that was not foretold.
    assert sigma_m[0] < 1.1e-3
    np.testing.assert_allclose(sigma_m[1:], 0.1, rtol=1e-6)


def test_without_any_event_the_forecast_stays():
    forecast = np.diag(np.square([0.1] * 12))
    np.testing.assert_array_equal(cautious_covariance(forecast, follower(0.0, 1).fit), forecast)


def followed(known_m_s):
    """One window more, the camera having begun to move all of a sudden; known speeds, m/s."""
    room = recording()
    eyes, window = eyes_on(room.line_map), window_at(100_000, room.events)
    start = roughly_at(room.pose(100_000), np.zeros(6), 100_000, CONFIG)
    one = Follower(fit_window(start, window, eyes.pieces, eyes.view, CONFIG, EVENT_SCALES_PX))
    speed = one.state.velocity + np.array([0.0, 0.0, 0.0, 0.6, 0.0, 0.0])
    held = one.state.covariance.copy()
    held[6:] = held[:, 6:] = 0.0
    held[6:, 6:] = known_m_s**2 * np.eye(6)
    one.fit = replace(one.fit, state=replace(one.state, velocity=speed, covariance=held))
    one.follow(window_at(100_000 + WINDOW_US, room.events), eyes, CONFIG)
    return one


def test_a_state_that_surprises_is_less_certain():
    calm, surprised = followed(0.5), followed(0.01)
    assert calm.fit.surprise < EXPECTED_SURPRISE < surprised.fit.surprise
    assert np.trace(surprised.state.covariance[3:6, 3:6]) > np.trace(
        calm.state.covariance[3:6, 3:6]
    )
