import numpy as np
import pytest

from roel_service.config.stages import TrackConfig
from roel_service.tracking.fit import fit_window
from roel_service.tracking.follower import Follower
from roel_service.tracking.locate import EVENT_SCALES_PX, roughly_at
from roel_service.tracking.pursuit import Pursuit

from .synthetic import eyes_on, recording, window_at

CONFIG = TrackConfig()
FIRST_US, NEXT_US = 100_000, 125_000
ASIDE = np.array([0.0, 0.03, 0.0, 0.1, 0.0, 0.0])


@pytest.fixture(scope="module")
def room():
    return recording()


def follower(room, pose):
    eyes, window = eyes_on(room.line_map), window_at(FIRST_US, room.events)
    start = roughly_at(pose, np.zeros(6), FIRST_US, CONFIG)
    return Follower(fit_window(start, window, eyes.pieces, eyes.view, CONFIG, EVENT_SCALES_PX))


def error_m(room, pursuit):
    state = pursuit.followers[0].state
    at = room.pose(state.t_us).translation
    return np.linalg.norm(state.T_world_camera.translation - at)


def test_what_a_challenge_found_is_followed_into_the_next_window(room):
    eyes, window = eyes_on(room.line_map), window_at(NEXT_US, room.events)
    wrong = follower(room, room.pose(FIRST_US).retract(ASIDE))
    pursuit = Pursuit([wrong], eyes, CONFIG)
    fit = pursuit.follow(window, lambda: [follower(room, room.pose(FIRST_US))])
    assert fit.state.t_us == NEXT_US
    assert fit is pursuit.followers[0].fit
    assert error_m(room, pursuit) < 0.01


def test_without_a_challenge_a_wrong_answer_is_lost(room):
    wrong = follower(room, room.pose(FIRST_US).retract(ASIDE))
    pursuit = Pursuit([wrong], eyes_on(room.line_map), CONFIG)
    pursuit.follow(window_at(NEXT_US, room.events))
    assert pursuit.is_over


def test_a_follower_goes_on_while_it_is_challenged(room):
    eyes, window = eyes_on(room.line_map), window_at(FIRST_US, room.events)

    def others(goes_on):
        pursuit = Pursuit([follower(room, room.pose(FIRST_US).retract(ASIDE))], eyes, CONFIG)
        challenge = pursuit.challenge(window, np.random.default_rng(1))
        if goes_on:
            pursuit.follow(window_at(NEXT_US, room.events))
        return [other.state.T_world_camera.matrix() for other in challenge.others()]

    at_once = others(goes_on=False)
    assert len(at_once) == 1
    np.testing.assert_array_equal(others(goes_on=True), at_once)


def test_where_nothing_is_followed_nothing_is_challenged(room):
    eyes, window = eyes_on(room.line_map), window_at(FIRST_US, room.events)
    pursuit = Pursuit([], eyes, CONFIG)
    assert pursuit.challenge(window, np.random.default_rng(0)) is None
