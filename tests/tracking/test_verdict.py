from dataclasses import replace

import numpy as np
import pytest

from roel_service.config.stages import TrackConfig
from roel_service.geometry.se3 import SE3
from roel_service.scene.results import PoseStatus
from roel_service.tracking.fit import Evidence, WindowFit
from roel_service.tracking.motion import MotionState
from roel_service.tracking.verdict import (
    CONTRADICTED_COUNT,
    CONVINCED_COUNT,
    PATIENCE_COUNT,
    WIDE,
    Verdict,
)

CONFIG = TrackConfig()


def fit(share=0.9, sharpness=80.0, moving_px=1000.0, surprise=1.0, sigma_m=0.001):
    width = 2.0  # of the band beside a line against that on it
    return WindowFit(
        state=MotionState(
            t_us=0,
            T_world_camera=SE3.identity(),
            velocity=np.zeros(6),
            covariance=sigma_m**2 * np.eye(12),
        ),
        surprise=surprise,
        evidence=Evidence(
            on_count=round(100 * sharpness),
            beside_count=round(100 * width),
            in_view_px=1000.0,
            moving_px=moving_px,
            seen_px=share * moving_px,
            moving_px2=5.0 * moving_px,
            seen_px2=5.0 * share * moving_px,
            seen_count=40,
        ),
        seen=np.ones(60, np.bool_),
        information=np.eye(12),
        information_of_edges=np.zeros((0, 12, 12)),
    )


def statuses(verdict, *fits):
    return [verdict.of(item, item.state.covariance, CONFIG) for item in fits]


@pytest.fixture
def convinced():
    verdict = Verdict()
    found = statuses(verdict, *[fit()] * CONVINCED_COUNT)
    assert found == [PoseStatus.UNCERTAIN] * (CONVINCED_COUNT - 1) + [PoseStatus.TRACKING]
    return verdict


def test_one_window_that_does_not_convince_costs_the_trust(convinced):
    doubtful = fit(sharpness=0.5 * CONFIG.min_sharpness)
    again = [doubtful, *[fit()] * CONVINCED_COUNT]
    assert statuses(convinced, *again) == [
        *[PoseStatus.UNCERTAIN] * CONVINCED_COUNT,
        PoseStatus.TRACKING,
    ]


def test_windows_that_contradict_lose_the_pose(convinced):
    poor = fit(share=0.7 * CONFIG.min_seen_share)
    expected = [PoseStatus.UNCERTAIN] * (CONTRADICTED_COUNT - 1) + [PoseStatus.LOST]
    assert statuses(convinced, *[poor] * CONTRADICTED_COUNT) == expected


def test_windows_that_lack_little_do_not_lose_the_pose(convinced):
    hidden = fit(share=0.9 * CONFIG.min_seen_share)
    again = [*[hidden] * 2 * CONTRADICTED_COUNT, *[fit()] * CONVINCED_COUNT]
    found = statuses(convinced, *again)
    assert found == [PoseStatus.UNCERTAIN] * (len(again) - 1) + [PoseStatus.TRACKING]


def test_one_window_with_hardly_anything_loses_it_at_once(convinced):
    assert statuses(convinced, fit(share=0.05)) == [PoseStatus.LOST]


def test_a_pose_that_never_convinces_is_given_up():
    doubtful = fit(sharpness=0.5 * CONFIG.min_sharpness)
    found = statuses(Verdict(), *[doubtful] * PATIENCE_COUNT)
    assert found == [PoseStatus.UNCERTAIN] * (PATIENCE_COUNT - 1) + [PoseStatus.LOST]


def test_a_camera_that_rests_keeps_what_was_said(convinced):
    assert statuses(convinced, fit(share=0.0, moving_px=10.0)) == [PoseStatus.TRACKING]


def test_a_pose_that_few_lines_hold_is_uncertain(convinced):
    loose = fit(sigma_m=2.0 * CONFIG.max_sigma_m)
    assert statuses(convinced, loose, fit()) == [PoseStatus.UNCERTAIN, PoseStatus.TRACKING]


def test_a_pose_that_one_edge_holds_is_uncertain(convinced):
    without_it = (2.0 * CONFIG.max_sigma_m) ** 2 * np.eye(12)
    assert convinced.of(fit(), without_it, CONFIG) is PoseStatus.UNCERTAIN


def test_a_pose_that_was_hardly_known_has_to_convince_again(convinced):
    wide = fit(sigma_m=2.0 * WIDE * CONFIG.max_sigma_m)
    expected = [*[PoseStatus.UNCERTAIN] * CONVINCED_COUNT, PoseStatus.TRACKING]
    assert statuses(convinced, wide, *[fit()] * CONVINCED_COUNT) == expected


def test_a_motion_that_does_not_go_on_costs_the_trust(convinced):
    assert statuses(convinced, fit(surprise=50.0), fit()) == [PoseStatus.UNCERTAIN] * 2


def test_a_few_pieces_are_chance(convinced):
    few = fit()
    few = replace(few, evidence=replace(few.evidence, seen_count=3))
    assert statuses(convinced, few) == [PoseStatus.UNCERTAIN]
