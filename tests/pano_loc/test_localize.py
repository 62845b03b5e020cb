"""Wireframe rooms: poses are found wherever they are, and what cannot be found is said."""

import numpy as np
import pytest

from roel_service.config.stages import LocalizeConfig
from roel_service.errors import InputError
from roel_service.evaluation.poses import rotation_errors_rad, translation_errors_m
from roel_service.geometry.se3 import SE3
from roel_service.pano_loc.hints import Gravity, PosePrior
from roel_service.pano_loc.localize import localize_arcs, localize_panorama
from roel_service.pano_loc.prepare import prepare_map
from roel_service.scene.lines import LineMap
from roel_service.scene.results import LocalizationStatus, NoPoseReason
from tests.pano_loc.rooms import (
    OTHER_FURNITURE,
    OTHER_ROOM,
    SYMMETRIC_FURNITURE,
    map_of,
    pose,
    seen_from,
    segments_of,
)

CONFIG = LocalizeConfig()
NOISE_RAD = 0.001
POSES = [
    pose(1.7, 1.5, 1.4, 0.0, 0.0, 2.5),
    pose(2.6, 1.3, 1.6, 0.3, -0.2, -1.0),
    pose(1.3, 2.2, 0.9, 2.5, 0.4, 0.3),
]


@pytest.fixture(scope="module")
def room():
    return prepare_map(map_of(noise_m=0.005), CONFIG)


def require_pose(result, truth, max_shift_m=0.01, max_turn_deg=0.3):
    assert result.status is LocalizationStatus.FOUND
    assert result.reason is None
    assert translation_errors_m(result.T_world_panorama, truth) < max_shift_m
    assert np.degrees(rotation_errors_rad(result.T_world_panorama, truth)) < max_turn_deg


@pytest.mark.parametrize("truth", POSES)
def test_a_panorama_of_the_room_is_found_however_it_is_tilted(room, truth):
    result = localize_arcs(seen_from(truth, segments_of(), noise_rad=NOISE_RAD), [room], CONFIG)
    require_pose(result, truth)
    covariance = result.hypotheses[0].covariance
    assert (np.linalg.eigvalsh(covariance) > 0).all()
    scores = [item.score for item in result.hypotheses]
    assert scores == sorted(scores, reverse=True)
    assert 0.0 <= scores[-1] <= scores[0] <= 1.0


@pytest.mark.parametrize(
    "motion",
    [
        pose(3.0, -8.0, 2.0, 0.4, 1.9, -0.7),
        pose(0, 0, 0, 0, 0, 0.09),
        pose(*np.random.default_rng(0).uniform(-3.0, 3.0, 6)),
    ],
)
def test_the_answer_moves_with_the_map(room, motion):
    truth = POSES[1]
    arcs = seen_from(truth, segments_of(), noise_rad=NOISE_RAD)
    moved = prepare_map(map_of(noise_m=0.005).transformed(motion), CONFIG)
    here, there = localize_arcs(arcs, [room], CONFIG), localize_arcs(arcs, [moved], CONFIG)
    assert there.status is here.status
    expected = motion @ here.T_world_panorama
    assert translation_errors_m(there.T_world_panorama, expected) < 0.002
    assert np.degrees(rotation_errors_rad(there.T_world_panorama, expected)) < 0.05


@pytest.mark.parametrize("seed", range(3))
def test_a_map_of_uprights_alone_is_enough_however_it_lies(seed):
    segments = segments_of()
    ends = segments[:, 1] - segments[:, 0]
    uprights = segments[ends[:, 2] != 0.0]
    # One line that is none, too short for a direction that counts: it turns with the map.
    lone = np.array([[[0.1, 0.5, 0.75], [0.8, 0.6, 0.75]]])
    motion = pose(*np.random.default_rng(seed).uniform(-3.0, 3.0, 6))
    line_map = LineMap.from_segments(np.concatenate([uprights, lone])).transformed(motion)
    arcs = seen_from(POSES[2], segments, noise_rad=NOISE_RAD)
    require_pose(localize_arcs(arcs, [prepare_map(line_map, CONFIG)], CONFIG), motion @ POSES[2])


def test_the_answer_turns_with_the_panorama(room):
    turn = pose(0, 0, 0, 0.0, 0.0, 1.1)
    arcs = [seen_from(truth, segments_of(), noise_rad=0.0) for truth in (POSES[0], POSES[0] @ turn)]
    first, second = (localize_arcs(item, [room], CONFIG).T_world_panorama for item in arcs)
    assert np.degrees(rotation_errors_rad(first @ turn, second)) < 0.1


def test_a_panorama_of_another_room_is_not_in_the_map(room):
    segments = segments_of(OTHER_ROOM, OTHER_FURNITURE)
    result = localize_arcs(seen_from(pose(2.4, 1.2, 1.4, 0, 0, 1.0), segments), [room], CONFIG)
    assert result.status is LocalizationStatus.NOT_FOUND
    assert result.reason is NoPoseReason.NOT_IN_MAP
    assert result.hypotheses == ()
    assert result.T_world_panorama is None


def test_a_room_that_equals_itself_after_half_a_turn_is_ambiguous():
    segments = segments_of(furniture=SYMMETRIC_FURNITURE)
    truth = POSES[0]
    result = localize_arcs(
        seen_from(truth, segments), [prepare_map(LineMap.from_segments(segments), CONFIG)], CONFIG
    )
    assert result.status is LocalizationStatus.AMBIGUOUS
    assert result.reason is NoPoseReason.AMBIGUOUS
    errors_m = [
        float(translation_errors_m(item.T_world_panorama, truth)) for item in result.hypotheses
    ]
    assert min(errors_m) < 0.01


def test_a_prior_resolves_what_is_ambiguous():
    segments = segments_of(furniture=SYMMETRIC_FURNITURE)
    truth = POSES[0]
    first = truth.retract(np.array([0.1, -0.2, 0.3, 0.4, -0.4, 0.3]))
    prior = PosePrior(T_world_picture=first)
    prepared = prepare_map(LineMap.from_segments(segments), CONFIG)
    require_pose(localize_arcs(seen_from(truth, segments), [prepared], CONFIG, prior=prior), truth)


def test_a_prior_far_from_the_truth_is_not_left(room):
    first = SE3(rotation=np.eye(3), translation=np.array([2.0, 1.6, 1.2]))
    prior = PosePrior(T_world_picture=first)
    arcs = seen_from(pose(1.7, 1.5, 1.4, 0, 0, 2.5), segments_of())
    result = localize_arcs(arcs, [room], CONFIG, prior=prior)
    assert result.status is LocalizationStatus.NOT_FOUND
    assert result.reason is NoPoseReason.NOT_IN_MAP


def test_poses_are_held_within_reach_of_a_prior():
    prior = PosePrior(T_world_picture=POSES[1], reach_m=0.5, reach_rad=0.3)
    steps = np.array([[0.2, 0, 0, 0.4, 0, 0], [0.5, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0.7, 0]])
    poses = [POSES[1].retract(step) for step in steps]
    batch = SE3(
        rotation=np.array([item.rotation for item in poses]),
        translation=np.array([item.translation for item in poses]),
    )
    assert prior.holds(batch).tolist() == [True, False, False]


@pytest.mark.parametrize("count", [0, 5])
def test_a_map_of_few_lines_says_so(count):
    prepared = prepare_map(LineMap.from_segments(segments_of()[:count]), CONFIG)
    result = localize_arcs(seen_from(POSES[0], segments_of()), [prepared], CONFIG)
    assert result.status is LocalizationStatus.NOT_FOUND
    assert result.reason is NoPoseReason.INSUFFICIENT_LINES


def test_a_black_picture_says_so(room):
    result = localize_panorama(np.zeros((256, 512), np.uint8), [room], CONFIG)
    assert result.reason is NoPoseReason.INSUFFICIENT_LINES


def test_lines_of_one_direction_leave_the_place_open():
    segments = segments_of()
    upright = segments[np.abs(segments[:, 1, 2] - segments[:, 0, 2]) > 0.3]
    result = localize_arcs(
        seen_from(POSES[0], upright), [prepare_map(LineMap.from_segments(upright), CONFIG)], CONFIG
    )
    assert result.status is not LocalizationStatus.FOUND


def test_the_map_that_holds_the_place_is_told(room):
    other = prepare_map(map_of(OTHER_ROOM, OTHER_FURNITURE, noise_m=0.005), CONFIG)
    truth = POSES[1]
    arcs = seen_from(truth, segments_of(), noise_rad=NOISE_RAD)
    result = localize_arcs(arcs, [other, room], CONFIG)
    require_pose(result, truth)
    assert result.hypotheses[0].map_index == 1


def test_the_same_map_twice_is_ambiguous(room):
    arcs = seen_from(POSES[0], segments_of(), noise_rad=NOISE_RAD)
    result = localize_arcs(arcs, [room, room], CONFIG)
    assert result.status is LocalizationStatus.AMBIGUOUS
    assert {item.map_index for item in result.hypotheses[:2]} == {0, 1}


@pytest.mark.parametrize("count", [0, 9])
def test_no_map_and_more_than_eight_are_refused(room, count):
    with pytest.raises(InputError, match=f"expected 1 to 8 maps, found {count}"):
        localize_arcs(seen_from(POSES[0], segments_of()), count * [room], CONFIG)


def test_gravity_leaves_few_orientations_and_finds_the_same_place(room):
    truth = POSES[1]
    up = np.array([0.0, 0.0, 1.0])
    gravity = Gravity(up_world=up, up_picture=truth.inverse().rotate(up))
    arcs = seen_from(truth, segments_of(), noise_rad=NOISE_RAD)
    free = localize_arcs(arcs, [room], CONFIG)
    result = localize_arcs(arcs, [room], CONFIG, gravity=gravity)
    require_pose(result, truth)
    assert result.rotation_count < free.rotation_count / 3


def test_a_room_is_found_among_others_in_one_map():
    shift = np.array([0.0, 3.4, 0.0])
    further = segments_of(OTHER_ROOM, OTHER_FURNITURE) + shift
    both = np.concatenate([segments_of(), further])
    both = both + np.random.default_rng(0).normal(0.0, 0.005, both.shape)
    prepared = prepare_map(LineMap.from_segments(both), CONFIG)
    # The picture shows the lines of its own room alone.
    result = localize_arcs(seen_from(POSES[1], segments_of()), [prepared], CONFIG)
    require_pose(result, POSES[1])
    truth = pose(2.4, 1.2 + shift[1], 1.4, 0.1, 0.0, 1.0)
    require_pose(localize_arcs(seen_from(truth, further), [prepared], CONFIG), truth)


def test_the_covariance_is_that_of_the_errors():
    squares = []
    for seed in range(6):
        segments = segments_of()
        noise = np.random.default_rng(seed).normal(0.0, 0.01, segments.shape)
        prepared = prepare_map(LineMap.from_segments(segments + noise), CONFIG)
        arcs = seen_from(POSES[0], segments, noise_rad=NOISE_RAD, seed=seed)
        result = localize_arcs(arcs, [prepared], CONFIG, prior=PosePrior(T_world_picture=POSES[0]))
        error = result.T_world_panorama.local(POSES[0])
        squares.append(error @ np.linalg.solve(result.hypotheses[0].covariance, error) / 6)
    assert 0.2 < np.mean(squares) < 4.0
