import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from roel_service.config.stages import REPRESENTATIONS, DetectConfig
from roel_service.mapping.frames import UNKNOWN_POLARITY
from roel_service.mapping.representations import SITS_RADIUS_PX, TOS_RADIUS_PX, event_images

from .synthetic import CAMERA, event_frame_of


def images_of(xy_px, t_us, polarity, blur_px=0.0, **changes):
    frame = event_frame_of((np.array(xy_px, float), np.array(t_us), np.array(polarity)))
    config = DetectConfig(blur_px=blur_px, **changes)
    return list(event_images(frame, config))


class TestAccumulated:
    XY_PX = ((10, 20), (30, 40), (10, 20), (50.4, 60.6))
    T_US = (0, 1_000, 5_000, 10_000)
    POLARITY = (1, -1, 1, -1)

    def images(self, representation, **changes):
        return images_of(
            self.XY_PX, self.T_US, self.POLARITY, representations=(representation,), **changes
        )

    def test_binary_is_white_where_an_event_fell(self):
        (image,) = self.images("binary")
        assert image.polarity == UNKNOWN_POLARITY
        assert sorted(zip(*np.nonzero(image.grey), strict=True)) == [(20, 10), (40, 30), (61, 50)]
        assert set(np.unique(image.grey)) == {0, 255}

    def test_timestamp_is_the_time_of_the_last_event_of_each_polarity(self):
        negative, positive = self.images("timestamp")
        assert (negative.polarity, positive.polarity) == (-1, 1)
        # 255 (t - first) / (last - first), rounded; the second event at a pixel replaces the first.
        assert negative.grey[40, 30] == round(255 * 0.1)
        assert negative.grey[61, 50] == 255
        assert positive.grey[20, 10] == round(255 * 0.5)
        assert np.count_nonzero(negative.grey) == 2
        assert np.count_nonzero(positive.grey) == 1

    def test_timestamp_of_events_at_one_time_is_black(self):
        images = images_of([(5, 5)] * 3, [7] * 3, [1] * 3, representations=("timestamp",))
        assert [image.grey.max() for image in images] == [0, 0]

    def test_count_tells_polarities_apart_and_count_sum_does_not(self):
        negative, positive = self.images("count")
        (both,) = self.images("count_sum")
        assert (negative.polarity, positive.polarity, both.polarity) == (-1, 1, 0)
        assert negative.grey[20, 10] == 0
        assert positive.grey[40, 30] == 0
        np.testing.assert_array_equal(both.grey > 0, (negative.grey > 0) | (positive.grey > 0))

    def test_count_grows_with_events_and_saturates(self):
        xy = [(10, 10)] * 1 + [(20, 20)] * 2 + [(30, 30)] * 3 + [(40, 40)] * 3
        (image,) = images_of(xy, np.zeros(9, int), np.ones(9, int))
        grey = [int(image.grey[p, p]) for p in (10, 20, 30)]
        # The 75th percentile of 1, 2, 3, 3 is 3: 255 (1 - exp(-1.2 n / 3)).
        assert grey == [round(255 * (1 - np.exp(-0.4 * n))) for n in (1, 2, 3)]

    def test_an_event_between_pixels_is_shared_by_them(self):
        (image,) = images_of([(10.5, 20.5)], [0], [1])
        assert image.grey[20:22, 10:12].min() == image.grey.max() > 0
        assert np.count_nonzero(image.grey) == 4

    def test_every_window_and_representation_has_its_images(self):
        frame = event_frame_of((np.full((20, 2), 30.0), np.arange(20), np.ones(20)))
        frame = dataclasses.replace(frame, windows=((8, 12), (0, 20), (3, 3)))
        config = DetectConfig(representations=("binary", "timestamp", "count_sum"))
        # The third window is empty and has none.
        assert len(list(event_images(frame, config))) == 2 * (1 + 2 + 1)

    def test_blur_spreads_an_event(self):
        (sharp,), (soft,) = self.images("binary"), self.images("binary", blur_px=1.0)
        assert np.count_nonzero(soft.grey) > np.count_nonzero(sharp.grey)

    @pytest.mark.parametrize("representation", REPRESENTATIONS)
    @pytest.mark.parametrize("place", [(np.nan, np.nan), (-3.0, 5.0), (1e9, 5.0), (159.7, 119.7)])
    def test_events_outside_the_image_are_left_out(self, representation, place):
        frame = event_frame_of(([(5.0, 5.0)], np.zeros(1), np.ones(1)))
        frame = dataclasses.replace(frame, compensated_px=np.array([place], np.float32))
        config = DetectConfig(representations=(representation,), blur_px=0.0)
        assert all(image.grey.max() == 0 for image in event_images(frame, config))


def places(count):
    """Pixels of a corner of the image, so that squares meet and are cut by its border."""
    return st.lists(
        st.tuples(st.integers(0, 14), st.integers(0, 11), st.sampled_from([-1, 1])),
        min_size=1,
        max_size=count,
    )


def surface_of(representation, events):
    xy_px, polarity = [event[:2] for event in events], [event[2] for event in events]
    return images_of(xy_px, np.arange(len(events)), polarity, representations=(representation,))


def square(surface, x, y, radius):
    """View of the square about a pixel, within the image."""
    return surface[max(0, y - radius) : y + radius + 1, max(0, x - radius) : x + radius + 1]


def moving_edge(step_us):
    """An upright edge that crosses 30 columns, one each `step_us`."""
    columns, rows = np.meshgrid(np.arange(60, 90), np.arange(20, 60), indexing="ij")
    xy_px = np.stack([columns.ravel(), rows.ravel()], axis=-1).astype(float)
    t_us = step_us * np.repeat(np.arange(30), 40)
    return xy_px, t_us, np.ones(len(t_us), np.int8)


class TestOrdinalSurfaces:
    @settings(max_examples=30, deadline=None)
    @given(places(80))
    def test_tos_follows_its_definition(self, events):
        surface = np.zeros((CAMERA.height, CAMERA.width), int)
        for x, y, _ in events:
            near = square(surface, x, y, TOS_RADIUS_PX)
            near -= 1
            near[near < 255 - 2 * (2 * TOS_RADIUS_PX + 1)] = 0
            surface[y, x] = 255
        (image,) = surface_of("tos", events)
        assert image.polarity == UNKNOWN_POLARITY
        np.testing.assert_array_equal(image.grey, surface)

    @settings(max_examples=30, deadline=None)
    @given(places(80))
    def test_sits_follows_its_definition(self, events):
        newest = (2 * SITS_RADIUS_PX + 1) ** 2
        surfaces = {label: np.zeros((CAMERA.height, CAMERA.width), int) for label in (-1, 1)}
        for x, y, polarity in events:
            surface = surfaces[polarity]
            near = square(surface, x, y, SITS_RADIUS_PX)
            near[near >= surface[y, x]] -= 1
            np.maximum(surface, 0, out=surface)
            surface[y, x] = newest
        images = surface_of("sits", events)
        assert [image.polarity for image in images] == [-1, 1]
        for image in images:
            expected = np.rint(surfaces[image.polarity] * (255 / newest))
            np.testing.assert_array_equal(image.grey, expected)

    @pytest.mark.parametrize("representation", ["tos", "sits"])
    def test_they_do_not_depend_on_the_speed_of_an_edge(self, representation):
        config = DetectConfig(representations=(representation,))
        slow, fast = (
            [image.grey for image in event_images(event_frame_of(moving_edge(step_us)), config)]
            for step_us in (100, 1_000)
        )
        np.testing.assert_array_equal(slow, fast)
        assert np.max(slow) > 0

    def test_only_the_newest_edge_is_left_of_tos(self):
        frame = event_frame_of(moving_edge(100))
        (image,) = event_images(frame, DetectConfig(representations=("tos",), blur_px=0.0))
        columns = np.flatnonzero(image.grey[30])
        # A column of 40 events takes seven from each pixel that it passes: two columns are 14.
        assert columns.max() == 89
        assert columns.min() >= 89 - 2

    def test_sits_falls_behind_the_edge(self):
        frame = event_frame_of(moving_edge(100))
        _, image = event_images(frame, DetectConfig(representations=("sits",), blur_px=0.0))
        behind = image.grey[40, 89 - SITS_RADIUS_PX : 90].astype(int)
        assert (np.diff(behind) > 0).all()
