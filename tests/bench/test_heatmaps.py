import numpy as np
import pytest

from roel_bench.heatmaps import PixelMatches, draw_lines, match_distance_px, match_pixels

SHAPE = (40, 60)


def drawn(*segments):
    return draw_lines(np.array(segments, dtype=float), SHAPE)


def test_line_is_one_pixel_wide():
    picture = drawn([[10, 20], [30, 20]])
    assert picture.sum() == 21
    assert picture[20, 10:31].all()


def test_parts_outside_the_picture_are_left_out():
    assert drawn([[-10, 5], [4, 5]]).sum() == 5
    assert draw_lines(np.empty((0, 2, 2)), SHAPE).sum() == 0


def test_equal_lines_match_whole():
    picture = drawn([[10, 20], [30, 20]])
    matches = match_pixels(picture, picture, 2.0)
    assert (matches.precision, matches.recall, matches.f_score) == (1.0, 1.0, 1.0)


def test_line_beside_the_edge_matches_within_the_distance_alone():
    line, edge = drawn([[10, 20], [30, 20]]), drawn([[10, 23], [30, 23]])
    assert match_pixels(line, edge, 3.0).f_score == 1.0
    assert match_pixels(line, edge, 2.9).f_score == 0.0


def test_an_edge_pays_for_one_line_only():
    twice = drawn([[10, 20], [30, 20]], [[10, 22], [30, 22]])
    edge = drawn([[10, 21], [30, 21]])
    matches = match_pixels(twice, edge, 2.0)
    assert matches.recall == 1.0
    assert matches.precision == 0.5
    assert matches.f_score == pytest.approx(2 / 3)


def test_half_of_an_edge_is_half_the_recall():
    matches = match_pixels(drawn([[10, 20], [19, 20]]), drawn([[10, 20], [29, 20]]), 1.0)
    assert matches.precision == 1.0
    assert matches.recall == 0.5


def test_nothing_matches_nothing():
    empty = np.zeros(SHAPE, bool)
    matches = match_pixels(empty, drawn([[10, 20], [30, 20]]), 2.0)
    assert (matches.precision, matches.recall, matches.f_score) == (0.0, 0.0, 0.0)
    assert match_pixels(empty, empty, 2.0) == PixelMatches()


def test_pictures_add_up_by_pixels():
    one = PixelMatches(line_pixel_count=10, edge_pixel_count=20, matched_count=10)
    two = PixelMatches(line_pixel_count=30, edge_pixel_count=20, matched_count=10)
    assert (one + two).precision == 0.5
    assert (one + two).recall == 0.5


def test_distance_is_a_share_of_the_diagonal():
    assert match_distance_px((480, 640)) == pytest.approx(8.0)
