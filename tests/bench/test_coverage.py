import numpy as np
import pytest

from roel_bench.coverage import coverage_figures
from roel_bench.scenes import part_of
from roel_service.geometry.projection import undistortion_table
from roel_service.mapping.frames import frames_at
from roel_service.scene.lines import LineMap
from tests.bench.samples import CAMERA, moving_camera, random_events

# Twelve frames, nearly at the origin.
FRAMES = frames_at(
    20_000 + np.arange(12) * 5_000, moving_camera(duration_us=100_000, speed_m_per_s=0.001), CAMERA
)
EVERYWHERE = random_events(20_000)
# 1.6 m at 2 m: 48 of 64 px.
SEEN = [[-0.8, 0.0, 2.0], [0.8, 0.0, 2.0]]


IDEAL_PX = undistortion_table(CAMERA)


def figures(true_lines, map_lines, events=EVERYWHERE):
    line_map = LineMap.from_segments(np.array(map_lines, dtype=float).reshape(-1, 2, 3))
    truth = np.array(true_lines, dtype=float)
    return coverage_figures(truth, line_map, FRAMES, events, IDEAL_PX)


@pytest.mark.parametrize(("end_m", "covered"), [(0.4, 1), (0.3, 0)])
def test_seven_tenths_within_3_cm_are_enough(end_m, covered):
    # From -0.8 m on: 1.2 of 1.6 m are 75 %, 1.1 m are 69 %, with 2 cm beyond the end each.
    found = [[-0.8, 0.02, 2.0], [end_m - 0.03, 0.02, 2.0]]
    result = figures([SEEN], [found])
    assert result["true_line_count"] == 1
    assert result["covered_line_share"] == covered


def test_too_far_is_not_covered():
    result = figures([SEEN], [[[-0.8, 0.04, 2.0], [0.8, 0.04, 2.0]]])
    assert result["covered_line_share"] == 0.0


def test_only_what_was_in_the_picture_counts():
    # Of 8 m some 2.1 m are in view, of the short one all of its 0.3 m, of the last one nothing.
    long = [[-4.0, 0.2, 2.0], [4.0, 0.2, 2.0]]
    short = [[-0.1, -0.2, 2.0], [0.2, -0.2, 2.0]]
    behind = [[-1.0, 0.0, -2.0], [1.0, 0.0, -2.0]]
    result = figures([long, short, behind], [[[-1.1, 0.2, 2.0], [1.1, 0.2, 2.0]]])
    assert result["true_line_count"] == 1
    assert result["covered_line_share"] == 1.0


def test_nothing_seen_and_nothing_found():
    assert figures([[[0, 0, -1], [1, 0, -1]]], [SEEN])["covered_line_share"] is None
    assert figures([SEEN], [])["covered_line_share"] == 0.0


def test_lines_without_events_are_not_active():
    # The upper line is 0.4 m above the lower one: 12 px. Events fall on the lower one alone.
    upper = [[-0.8, -0.4, 2.0], [0.8, -0.4, 2.0]]
    lower_row = EVERYWHERE.y == 23
    events = part_of(EVERYWHERE, lower_row)
    result = figures([SEEN, upper], [SEEN], events)
    assert (result["true_line_count"], result["covered_line_share"]) == (2, 0.5)
    assert (result["active_line_count"], result["covered_active_line_share"]) == (1, 1.0)
