from dataclasses import replace

import numpy as np
import pytest

from roel_service.config.stages import TrackConfig
from roel_service.geometry.se3 import SE3
from roel_service.tracking import search_kernels
from roel_service.tracking.locate import locating
from roel_service.tracking.sight import glimpse

from .synthetic import eyes_on, recording, result_of, window_at

CONFIG = TrackConfig()
T_US = 100_000


@pytest.fixture(scope="module")
def room():
    return recording()


def located(room, guess, seen=slice(None)):
    eyes = eyes_on(room.line_map)
    first, last = np.searchsorted(room.events.t_us, [T_US - 25_000, T_US + 25_000])
    sight = glimpse(room.events.part(int(first), int(last)), T_US, eyes)
    columns = ("segments_px", "polarity", "normal_speed_px_per_ms")
    lines = replace(sight.lines, **{name: getattr(sight.lines, name)[seen] for name in columns})
    window = window_at(T_US, room.events)
    rng = np.random.default_rng(0)
    return result_of(locating(guess, replace(sight, lines=lines), window, eyes, CONFIG, rng))


def test_the_best_fit_is_where_the_camera_is(room):
    aside = room.pose(T_US).retract(np.array([0.0, 0.1, 0.0, 0.1, 0.0, 0.0]))
    found = located(room, aside)[0].state.T_world_camera
    assert np.abs(found.local(room.pose(T_US))).max() < 0.01


def test_without_lines_in_sight_nothing_is_found(room):
    assert located(room, room.pose(T_US), slice(0, 0)) == []


def test_where_nothing_of_the_map_can_be_seen_nothing_is_found(room):
    backwards = SE3(rotation=np.diag([-1.0, 1.0, -1.0]), translation=np.array([0.0, 0.0, -50.0]))
    assert located(room, backwards) == []


def test_a_point_on_a_line_tells_more_than_chance_and_two_tell_more_than_one():
    fields = np.zeros((12, 20, 20), np.float32)
    fields[0, 10] = 1.0
    points = np.array([[0.0, 0.0, 1.0], [2.0, 0.0, 1.0], [0.0, 4.0, 1.0]])
    level = np.tile([1.0, 0.0, 0.0], (3, 1))
    K = np.array([[1.0, 0.0, 10.0], [0.0, 1.0, 10.0], [0.0, 0.0, 1.0]])

    def score(count):
        mean, variance = fields.mean(axis=(1, 2)), fields.var(axis=(1, 2))
        pose = np.eye(3)[None], np.zeros((1, 3))
        arrays = points[:count], level[:count], K, fields
        return search_kernels.scores(
            *pose, *arrays, mean.astype(float), variance.astype(float), 1.0, 0.1
        )[0]

    assert 0.0 < score(1) < score(2)
    # The third lies beside the line.
    assert score(3) < score(2)
    assert score(0) == 0.0


def test_directions_are_told_well_enough_for_their_classes():
    angle = np.linspace(-np.pi, np.pi, 1001)
    told = [search_kernels.half_turns(np.cos(a), np.sin(a)) for a in angle]
    off = (np.array(told) - angle / np.pi + 0.5) % 1.0 - 0.5
    assert np.abs(off).max() < 0.0014
