import numpy as np
import pytest

from roel_service.geometry.segments import length
from roel_service.pano_loc.coverage import covered, credit, line_points, two_way_score
from roel_service.pano_loc.refine import FINAL_STEP_RAD, sample_arcs
from tests.pano_loc.rooms import pose, seen_from, segments_of

TRUTH = pose(1.7, 1.6, 1.4, 0.1, 0.2, 0.8)


def shown_of(T, arcs, lines):
    return covered(T, sample_arcs(arcs, FINAL_STEP_RAD), arcs.sides, lines)


def test_points_stand_for_the_whole_length_of_their_lines():
    lines = line_points(segments_of(), 0.1)
    assert lines.length_m.sum() == pytest.approx(length(segments_of()).sum())
    assert lines.length_m.max() <= 0.1 + 1e-9
    assert len(lines.offsets) == len(segments_of()) + 1


def test_a_picture_shows_the_map_where_it_was_taken_and_little_of_it_elsewhere():
    arcs, lines = seen_from(TRUTH, segments_of()), line_points(segments_of(), 0.1)
    here = shown_of(TRUTH, arcs, lines)
    there = shown_of(TRUTH.retract(np.array([0.2, 0.3, 0.1, 0.5, 0.4, 0.2])), arcs, lines)
    assert here > 0.95
    assert there < 0.5 * here


def test_of_half_the_lines_about_half_is_shown():
    segments = segments_of()
    arcs = seen_from(TRUTH, segments[::2])
    shown = shown_of(TRUTH, arcs, line_points(segments, 0.1))
    assert 0.3 < shown < 0.8


def test_the_picture_counts_four_times_as_much_as_the_map():
    assert two_way_score(1.0, 1.0) == 1.0
    assert two_way_score(1.0, 0.0) == pytest.approx(4 * two_way_score(0.0, 1.0))


def test_a_match_among_many_lines_counts_little_unless_it_is_close():
    off = np.deg2rad([0.5, 0.5, 0.02, np.inf])
    alone, crowded, close, none = credit(off, np.array([1, 10, 10, 0]))
    assert crowded < 0.5 * alone
    assert close > 0.9
    assert none == pytest.approx(0.0, abs=1e-12)
