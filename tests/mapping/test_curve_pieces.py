import numpy as np

from roel_service.config.stages import Config, CurvesConfig, DetectConfig
from roel_service.mapping.curve_pieces import _along_lines, cut, pieces_of_frame
from roel_service.mapping.detect import EDLines
from roel_service.mapping.plane_fit import NO_LINES, fit_space_time_planes
from roel_service.mapping.representations import event_images

from .synthetic import event_frame_of

CONFIG = Config(curves=CurvesConfig(method="polyline"))
RADIUS_PX, MIDDLE_PX = 40.0, np.array([80.0, 60.0])


def circle_frame(count=6000):
    """Events of a circle that stays in place."""
    rng = np.random.default_rng(0)
    angle = rng.uniform(0, 2 * np.pi, count)
    xy_px = MIDDLE_PX + RADIUS_PX * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    t_us = np.sort(rng.integers(-10_000, 10_000, count))
    return event_frame_of((xy_px, t_us, np.ones(count, np.int8)), width=160, height=120)


def test_pieces_follow_a_circle_within_a_fraction_of_a_pixel():
    frame = circle_frame()
    images = list(event_images(frame, CONFIG.detect))
    drawing = EDLines(DetectConfig())
    pieces = pieces_of_frame(images, NO_LINES, frame, drawing, CONFIG)
    ends_px = np.linalg.norm(pieces.segments_px - MIDDLE_PX, axis=-1) - RADIUS_PX
    middle_px = np.linalg.norm(pieces.segments_px.mean(axis=1) - MIDDLE_PX, axis=-1) - RADIUS_PX
    # The arc over 16 px bulges 0.8 px from its chord; the fit lies between.
    assert np.abs(ends_px).max() < 1.2
    assert np.median(np.abs(middle_px)) < 0.4
    angle = np.arctan2(*(pieces.segments_px.mean(axis=1) - MIDDLE_PX).T)
    assert (np.histogram(angle, 12, (-np.pi, np.pi))[0] > 0).all()
    assert len(pieces.event_dt_us) == 0


def test_pieces_are_cut_along_their_chains():
    steps = np.arange(30)
    horizontal = np.stack([steps, np.full(30, 7)], axis=-1)
    vertical = np.stack([np.full(12, 50), np.arange(12)], axis=-1)
    pieces = cut([horizontal, vertical, np.array([[0, 0], [1, 1]])], 10.0)
    ends = np.sort(pieces[:3, :, 0], axis=1)
    np.testing.assert_allclose(ends, [[0, 9], [10, 19], [20, 29]], atol=1e-9)
    np.testing.assert_allclose(pieces[:3, :, 1], 7.0)
    np.testing.assert_allclose(pieces[3][:, 0], 50.0)
    assert len(pieces) == 4  # two pixels have no direction
    assert cut([], 10.0).shape == (0, 2, 2)


def test_pieces_along_a_long_line_are_its_own():
    line = np.array([[[0.0, 0.0], [60.0, 0.0]]])
    pieces = np.array(
        [
            [[10.0, 1.0], [20.0, -1.0]],
            [[10.0, 0.0], [20.0, 6.0]],
            [[58.0, 0.0], [68.0, 0.0]],
        ]
    )
    assert _along_lines(pieces, line, 40.0).tolist() == [True, False, False]
    assert not _along_lines(pieces, line, 61.0).any()
    assert not _along_lines(pieces, np.empty((0, 2, 2)), 40.0).any()


def test_no_lines_are_what_a_fit_of_nothing_gives():
    frame = circle_frame(10)
    config = CONFIG.plane_fit
    nothing = fit_space_time_planes(NO_LINES, frame, config, np.random.default_rng(0))
    for name, value in vars(NO_LINES).items():
        assert getattr(nothing, name).shape == value.shape
