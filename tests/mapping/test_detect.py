import dataclasses
import types

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from roel_service.config.stages import DetectConfig
from roel_service.errors import ConfigError
from roel_service.geometry import segments
from roel_service.mapping.detect import LSD, EDLines, detect_lines, line_detector, merge_seeds
from roel_service.mapping.representations import EventImage

from .synthetic import CAMERA

CENTRE_PX = np.array([79.5, 59.5])
SHAPE = (CAMERA.height, CAMERA.width)


def step_edge(angle_rad, offset_px):
    """An image that is dark on one side of a line, and the line's unit normal.

    The line passes `offset_px` beside the image's centre; the edge is as smooth as event images.
    """
    normal = np.array([-np.sin(angle_rad), np.cos(angle_rad)])
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]]
    beside = (column - CENTRE_PX[0]) * normal[0] + (row - CENTRE_PX[1]) * normal[1] - offset_px
    # The area of a pixel on the bright side, to first order.
    grey = 20 + 200 * np.clip(beside + 0.5, 0, 1)
    return np.rint(cv2.GaussianBlur(grey, (0, 0), 1.0)).astype(np.uint8), normal


class LineDetectorContract:
    """What every detector must do; the detector is made by `detector`."""

    def detector(self):
        raise NotImplementedError

    # Edge pixels are whole pixels. Their rounding averages out along a slanted line; along rows,
    # columns and diagonals all of them are rounded alike, by up to half a pixel.
    @pytest.mark.parametrize(
        ("angle_deg", "tolerance_px"),
        [(7, 0.1), (30, 0.1), (68, 0.1), (115, 0.1), (170, 0.1), (0, 0.5), (45, 0.5), (90, 0.5)],
    )
    @pytest.mark.parametrize("offset_px", [0.3, -0.4, 5.2])
    def test_an_ideal_edge_is_found_to_a_fraction_of_a_pixel(
        self, angle_deg, tolerance_px, offset_px
    ):
        grey, normal = step_edge(np.deg2rad(angle_deg), offset_px)
        found = self.detector().detect(grey)
        assert found.dtype == np.float64
        assert found.shape == (1, 2, 2)
        assert np.abs((found[0] - CENTRE_PX) @ normal - offset_px).max() < tolerance_px
        assert segments.length(found)[0] > 100

    @pytest.mark.parametrize("level", [0, 128, 255])
    def test_an_image_without_edges_has_no_lines(self, level):
        assert self.detector().detect(np.full(SHAPE, level, np.uint8)).shape == (0, 2, 2)

    def test_calls_do_not_depend_on_earlier_ones(self):
        detector = self.detector()
        first, second = step_edge(0.3, 0.0)[0], step_edge(1.2, 4.0)[0]
        alone = self.detector().detect(second)
        detector.detect(first)
        np.testing.assert_array_equal(detector.detect(second), alone)

    def test_the_image_is_left_as_it_was(self):
        grey, _ = step_edge(0.3, 0.0)
        before = grey.copy()
        self.detector().detect(grey)
        np.testing.assert_array_equal(grey, before)


class TestEDLines(LineDetectorContract):
    def detector(self):
        return EDLines(DetectConfig())

    @pytest.mark.parametrize("changes", [{"gradient_threshold": 100}, {"anchor_threshold": 250}])
    def test_thresholds_hide_weak_edges(self, changes):
        grey, _ = step_edge(0.3, 0.0)
        faint = (grey // 8).astype(np.uint8)
        assert len(EDLines(DetectConfig()).detect(faint)) == 1
        assert len(EDLines(DetectConfig(**changes)).detect(faint)) == 0

    @pytest.mark.parametrize("rest", [None, types.ModuleType("ximgproc")])
    def test_an_opencv_without_edlines_is_told_with_its_remedy(self, monkeypatch, rest):
        # What another wheel leaves behind: no module, or its folder alone.
        monkeypatch.setattr(cv2, "ximgproc", rest)
        with pytest.raises(ConfigError) as caught:
            EDLines(DetectConfig())
        assert str(caught.value) == (
            "detect.detector: expected an OpenCV with edlines; pip install --force-reinstall "
            "--no-deps opencv-contrib-python-headless brings it back, found cv2 of another "
            "OpenCV package"
        )

    def test_a_bent_edge_is_one_line_when_the_fit_may_be_loose(self):
        row, column = np.mgrid[: SHAPE[0], : SHAPE[1]]
        bend = 60 + 4.0 * ((column - 80) / 80.0) ** 2
        grey = np.where(row > bend, 220, 20).astype(np.uint8)
        grey = cv2.GaussianBlur(grey, (0, 0), 1.0)
        strict = EDLines(DetectConfig(line_fit_error_px=0.5)).detect(grey)
        loose = EDLines(DetectConfig(line_fit_error_px=4.0)).detect(grey)
        assert segments.length(loose).max() > segments.length(strict).max()


class TestLSD(LineDetectorContract):
    def detector(self):
        return LSD()


def test_the_configuration_names_the_detector():
    assert isinstance(line_detector(DetectConfig(detector="edlines")), EDLines)
    assert isinstance(line_detector(DetectConfig(detector="lsd")), LSD)


CONFIG = DetectConfig(merge_distance_px=1.0, merge_overlap=0.8)


def seeds_of(*lines, polarity=None, config=CONFIG):
    lines = np.array(lines, float).reshape(-1, 2, 2)
    polarity = np.zeros(len(lines), np.int8) if polarity is None else np.array(polarity, np.int8)
    return merge_seeds(lines, polarity, config)


class TestMergeSeeds:
    LONG = ((10, 10), (50, 10))
    SHORT = ((15, 10.5), (35, 10.5))

    def test_the_longer_of_two_close_lines_stays(self):
        np.testing.assert_array_equal(seeds_of(self.SHORT, self.LONG).segments_px, [self.LONG])

    def test_lines_of_different_polarity_both_stay(self):
        seeds = seeds_of(self.SHORT, self.LONG, polarity=[-1, 1])
        np.testing.assert_array_equal(seeds.segments_px, [self.LONG, self.SHORT])
        np.testing.assert_array_equal(seeds.polarity, [1, -1])

    def test_a_line_farther_off_stays(self):
        assert len(seeds_of(self.LONG, ((15, 11.2), (35, 11.2)))) == 2

    def test_a_line_that_leaves_at_one_end_stays(self):
        assert len(seeds_of(self.LONG, ((15, 10), (35, 12)))) == 2

    def test_a_line_that_mostly_continues_another_stays(self):
        # 20 px long, of which 15 face the longer one: a share of 0.75.
        assert len(seeds_of(self.LONG, ((35, 10), (55, 10)))) == 2
        assert len(seeds_of(self.LONG, ((33, 10), (53, 10)))) == 1

    def test_without_an_overlap_rule_any_facing_part_merges_but_a_gap_does_not(self):
        config = DetectConfig(merge_distance_px=1.0, merge_overlap=0.0)
        assert len(seeds_of(self.LONG, ((45, 10), (80, 10)), config=config)) == 1
        assert len(seeds_of(self.LONG, ((55, 10), (80, 10)), config=config)) == 2

    def test_a_dropped_line_drops_no_others(self):
        near, far = ((10, 10.9), (45, 10.9)), ((10, 11.8), (40, 11.8))
        # `far` lies along `near` alone, and `near` is gone.
        np.testing.assert_array_equal(
            seeds_of(self.LONG, near, far).segments_px, np.array([self.LONG, far])
        )

    def test_no_lines_give_no_seeds(self):
        assert len(seeds_of()) == 0

    @given(st.permutations(range(6)))
    def test_lines_of_different_lengths_may_come_in_any_order(self, order):
        lines = np.array(
            [((10, 10 + 0.4 * i), (50 - 3 * i, 10 + 0.4 * i)) for i in range(6)], float
        )
        expected = seeds_of(*lines).segments_px
        np.testing.assert_array_equal(seeds_of(*lines[order]).segments_px, expected)


class ListedLines:
    """A detector that answers what it was given."""

    def __init__(self, *lines):
        self.lines = np.array(lines, float)

    def detect(self, grey):
        return self.lines


class TestDetectLines:
    def image(self, polarity=0):
        return EventImage(grey=np.zeros(SHAPE, np.uint8), polarity=polarity)

    def test_lines_of_all_images_are_pooled_with_their_polarity(self):
        detector = ListedLines(((10, 10), (50, 10)), ((20, 30), (20, 90)))
        seeds = detect_lines([self.image(1), self.image(-1), self.image(1)], detector, CONFIG)
        # The third image repeats the first.
        assert len(seeds) == 4
        np.testing.assert_array_equal(seeds.polarity, [1, -1, 1, -1])
        assert (np.diff(segments.length(seeds.segments_px)) <= 0).all()

    def test_lines_of_all_images_may_be_merged_whatever_their_polarity(self):
        detector = ListedLines(((10, 10), (50, 10)), ((20, 30), (20, 90)))
        config = dataclasses.replace(CONFIG, merge_across_polarities=True)
        seeds = detect_lines([self.image(1), self.image(-1), self.image()], detector, config)
        assert len(seeds) == 2
        np.testing.assert_array_equal(seeds.polarity, [0, 0])

    @pytest.mark.parametrize(
        ("config", "kept"),
        [
            (DetectConfig(min_length_px=15.0, min_length_width_share=0.0), 2),
            (DetectConfig(min_length_px=25.0, min_length_width_share=0.0), 1),
            # A quarter of the width is 40 px.
            (DetectConfig(min_length_px=15.0, min_length_width_share=0.25), 0),
        ],
    )
    def test_short_lines_are_left_out(self, config, kept):
        detector = ListedLines(((10, 10), (30, 10)), ((10, 50), (40, 50)), ((5, 5), (5, 5)))
        assert len(detect_lines([self.image()], detector, config)) == kept

    def test_no_images_and_blank_images_have_no_lines(self):
        assert len(detect_lines([], EDLines(CONFIG), CONFIG)) == 0
        seeds = detect_lines([self.image()], EDLines(CONFIG), CONFIG)
        assert len(seeds) == 0
        assert seeds.segments_px.shape == (0, 2, 2)
