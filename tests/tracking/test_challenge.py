from dataclasses import replace

import numpy as np
import pytest

from roel_service.config.stages import TrackConfig
from roel_service.scene.lines import LineMap
from roel_service.tracking.challenge import Challenge
from roel_service.tracking.fit import fit_window
from roel_service.tracking.follower import Follower
from roel_service.tracking.locate import EVENT_SCALES_PX, roughly_at

from .synthetic import events_of, eyes_on, motion, recording, window_at

CONFIG = TrackConfig()
T_US = 100_000
SEEDS = range(6)


def fitted(pose, window, eyes):
    start = roughly_at(pose, np.zeros(6), T_US, CONFIG)
    return fit_window(start, window, eyes.pieces, eyes.view, CONFIG, EVENT_SCALES_PX)


def found(fit, window, eyes):
    """What several challenges of a fit end in, without those that come back."""
    follower = Follower(fit)
    challenges = [
        Challenge(follower, window, eyes, CONFIG, np.random.default_rng(seed)) for seed in SEEDS
    ]
    return [other.fit for challenge in challenges for other in challenge.others()]


@pytest.fixture(scope="module")
def room():
    return recording()


def test_from_the_right_place_every_challenge_comes_back(room):
    eyes, window = eyes_on(room.line_map), window_at(T_US, room.events)
    assert found(fitted(room.pose(T_US), window, eyes), window, eyes) == []


def test_beside_a_wrong_place_a_challenge_finds_what_explains_more(room):
    eyes, window = eyes_on(room.line_map), window_at(T_US, room.events)
    aside = room.pose(T_US).retract(np.array([0.0, 0.03, 0.0, 0.1, 0.0, 0.0]))
    wrong = fitted(aside, window, eyes)
    assert (
        np.linalg.norm(wrong.state.T_world_camera.translation - room.pose(T_US).translation) > 0.05
    )
    most = max(fit.evidence.explained_count for fit in found(wrong, window, eyes))
    assert most > 1.5 * wrong.evidence.explained_count


def test_along_upright_bars_another_answer_explains_about_as_much():
    upright = [[[x, -1.2, 2.5], [x, 1.2, 2.5]] for x in np.arange(-2.0, 2.01, 0.12)]
    level = [[[-2.4, y, 2.5], [2.4, y, 2.5]] for y in (-0.9, 0.0, 0.9)]
    bars = np.array(upright + level)
    t_us = np.arange(80_000, 121_000, 1_000)
    poses = motion(t_us)
    events = events_of(bars, t_us, poses, np.random.default_rng(1))
    eyes, window = eyes_on(LineMap.from_segments(bars)), window_at(T_US, events)
    right = fitted(poses[20], window, eyes)
    wide = right.state.stepped(np.zeros(12), 100.0 * right.state.covariance)
    others = found(replace(right, state=wide), window, eyes)
    assert max(fit.evidence.explained_count for fit in others) > (
        0.9 * right.evidence.explained_count
    )


def test_a_thinned_window_has_events_of_all_its_time(room):
    window = window_at(T_US, room.events)
    few = window.thinned(500)
    assert 250 < len(few.slot) == len(few.xy_px) <= 500
    assert set(few.slot) == set(window.slot)
    assert few.event_count == window.event_count
