import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from roel_service.config.stages import DetectConfig, FramesConfig
from roel_service.geometry import projection
from roel_service.geometry.projection import undistortion_table
from roel_service.geometry.se3 import SE3, rotation_from_vector
from roel_service.mapping import frames_kernels
from roel_service.mapping.frames import (
    event_frame,
    frame_slices,
    frame_times,
    frames_at,
    window_event_counts,
    window_range,
)
from roel_service.mapping.representations import event_images
from roel_service.scene.camera import Camera, CameraModel
from roel_service.scene.events import EventStream
from roel_service.scene.trajectory import MAX_POSE_GAP_US, Trajectory

from .synthetic import CAMERA, trajectory

WINDOW = FramesConfig(min_half_window_us=10, max_half_window_us=100)


def resting(*t_us):
    """A camera that does not move, with poses at these times."""
    count = len(t_us)
    pose = SE3(rotation=np.tile(np.eye(3), (count, 1, 1)), translation=np.zeros((count, 3)))
    return Trajectory(t_us=np.array(t_us), T_world_camera=pose)


def stream(t_us, x=None, y=None, polarity=None):
    count = len(t_us)
    return EventStream(
        t_us=np.asarray(t_us, np.int64),
        x=np.zeros(count, np.uint16) if x is None else np.asarray(x, np.uint16),
        y=np.zeros(count, np.uint16) if y is None else np.asarray(y, np.uint16),
        polarity=np.ones(count, np.int8) if polarity is None else np.asarray(polarity, np.int8),
        width=CAMERA.width,
        height=CAMERA.height,
    )


def cut(events, places):
    """The stream in pieces."""
    bounds = [0, *sorted(places), len(events)]
    for start, stop in itertools.pairwise(bounds):
        part = events.slice(start, stop, 0)
        yield stream(part.t_us, part.x, part.y, part.polarity)


class TestWindowRange:
    def test_half_of_the_events_lie_on_each_side(self):
        t_us = np.arange(0, 2000, 2)
        assert window_range(t_us, 1000, 40, WINDOW) == (480, 520)

    def test_sparse_events_are_cut_at_the_longest_window(self):
        t_us = np.arange(0, 2000, 20)
        start, stop = window_range(t_us, 1000, 40, WINDOW)
        assert t_us[start:stop].tolist() == list(range(900, 1100, 20))

    def test_dense_events_fill_the_shortest_window(self):
        t_us = np.repeat(np.arange(900, 1100), 10)
        start, stop = window_range(t_us, 1000, 4, WINDOW)
        assert (t_us[start], t_us[stop - 1]) == (990, 1009)

    def test_events_of_one_time_are_all_in_the_window_or_none(self):
        t_us = np.array([0, 40, 40, 40, 60, 60, 60, 90])
        start, stop = window_range(t_us, 50, 4, WINDOW)
        assert t_us[start:stop].tolist() == [40, 40, 40, 60, 60, 60]

    def test_no_events_give_an_empty_window(self):
        assert window_range(np.empty(0, np.int64), 5, 10, WINDOW) == (0, 0)

    @given(
        st.lists(st.integers(0, 400), max_size=60).map(sorted),
        st.integers(0, 400),
        st.integers(1, 80),
    )
    def test_window_lies_between_its_bounds(self, t_us, centre_us, count):
        t_us = np.array(t_us, np.int64)
        start, stop = window_range(t_us, centre_us, count, WINDOW)
        distance_us = np.abs(t_us - centre_us + 0.5)  # half-open: the end itself is outside
        inside = np.zeros(len(t_us), bool)
        inside[start:stop] = True
        assert inside[distance_us < 10].all()
        assert not inside[distance_us > 100].any()

    def test_counts_are_sorted_and_given_ones_take_precedence(self):
        dense = DetectConfig(window_events_per_pixel=(0.3, 0.1))
        assert window_event_counts(dense, 1000) == (100, 300)
        given_counts = DetectConfig(window_event_counts=(50, 7))
        assert window_event_counts(given_counts, 1000) == (7, 50)

    def test_a_tiny_sensor_still_has_one_event_in_its_window(self):
        assert window_event_counts(DetectConfig(window_events_per_pixel=(0.01,)), 10) == (1,)


class TestFrameTimes:
    CONFIG = FramesConfig(rate_hz=100.0, min_frame_count=5, max_half_window_us=25_000)

    def test_frames_are_evenly_spaced_and_their_windows_covered(self):
        times = frame_times(resting(0, 400_000), (0, 400_000), self.CONFIG)
        assert times == list(range(25_000, 375_001, 10_000))

    def test_events_shorter_than_the_poses_limit_the_frames(self):
        times = frame_times(resting(0, 400_000), (100_000, 250_000), self.CONFIG)
        assert times == list(range(125_000, 225_001, 10_000))

    def test_a_short_recording_gets_its_least_number_of_frames(self):
        times = frame_times(resting(0, 60_000), (0, 60_000), self.CONFIG)
        assert times == [25_000, 27_000, 29_000, 31_000, 33_000, 35_000]

    def test_an_unknown_range_takes_that_of_the_poses_at_the_configured_rate(self):
        times = frame_times(resting(0, 60_000), None, self.CONFIG)
        assert times == [25_000, 35_000]

    def test_no_window_reaches_into_a_gap_of_the_poses(self):
        gap_end_us = 200_000 + MAX_POSE_GAP_US + 1
        poses = resting(0, 200_000, gap_end_us, gap_end_us + 100_000)
        times = np.array(frame_times(poses, (0, gap_end_us + 100_000), self.CONFIG))
        assert len(times) > 0
        assert poses.covers(times - 25_000).all()
        assert poses.covers(times + 25_000).all()
        assert times[0] == 25_000
        assert gap_end_us + 25_000 in times

    def test_a_recording_shorter_than_one_window_has_no_frame(self):
        assert frame_times(resting(0, 400_000), (0, 49_999), self.CONFIG) == []

    def test_a_recording_of_exactly_one_window_has_one_frame(self):
        assert frame_times(resting(0, 400_000), (0, 50_000), self.CONFIG) == [25_000]

    def test_poses_of_another_time_give_no_frame(self):
        assert frame_times(resting(0, 400_000), (5_000_000, 6_000_000), self.CONFIG) == []


class TestFrameSlices:
    @given(
        st.lists(st.integers(0, 300), max_size=50).map(sorted),
        st.lists(st.integers(0, 50), max_size=8),
        st.lists(st.integers(0, 330), max_size=8, unique=True).map(sorted),
        st.integers(1, 40),
    )
    def test_windows_do_not_depend_on_the_chunks(self, t_us, places, times_us, reach_us):
        # Every event is another pixel, so that windows can be compared event by event.
        whole = stream(t_us, x=np.arange(len(t_us)))
        chunks = cut(whole, [min(place, len(t_us)) for place in places])
        found = dict(frame_slices(chunks, times_us, reach_us))
        last_us = t_us[-1] if t_us else -1
        assert list(found) == [time for time in times_us if time + reach_us <= last_us]
        for time, part in found.items():
            expected, window = whole.around(time, reach_us), part.around(time, reach_us)
            np.testing.assert_array_equal(window.x, expected.x)
            np.testing.assert_array_equal(window.t_us, expected.t_us)

    def test_memory_holds_one_chunk_and_one_window(self):
        events = stream(np.arange(100_000))
        chunks = cut(events, range(1_000, 100_000, 1_000))
        longest = max(len(part) for _, part in frame_slices(chunks, [500, 50_000, 99_000], 200))
        # The chunk that completes a window, and what of the window came before it.
        assert longest <= 1_000 + 2 * 200

    def test_all_chunks_are_read_even_after_the_last_frame(self):
        read = []

        def chunks():
            for part in cut(stream(np.arange(1_000)), [250, 500, 750]):
                read.append(len(part))
                yield part

        assert len(list(frame_slices(chunks(), [100], 50))) == 1
        assert read == [250] * 4


def seen(directions, R_world_camera):
    """Where far points appear, px."""
    return projection.project(
        np.einsum("...ji,...j->...i", R_world_camera, directions), CAMERA.matrix
    )


class TestRotationCompensation:
    """The pixel of event k comes from row 0, column k of the table, so it can be any."""

    T_REF_US = 500_000

    def far_points(self, t_us):
        rng = np.random.default_rng(0)
        poses = trajectory()
        R = poses.interpolate(t_us).rotation
        directions = np.column_stack([rng.uniform(-0.3, 0.3, (len(t_us), 2)), np.ones(len(t_us))])
        table = np.full((CAMERA.height, CAMERA.width, 2), np.nan, np.float32)
        table[0, : len(t_us)] = seen(directions, R)
        now = seen(directions, poses.interpolate(np.array([self.T_REF_US])).rotation[0])
        return poses, table, now

    def compensated(self, t_us, slot_us, **changes):
        poses, table, now = self.far_points(t_us)
        config = FramesConfig(slot_us=slot_us, **changes)
        events = stream(t_us, x=np.arange(len(t_us)))
        detect = DetectConfig(window_event_counts=(500,))
        frame = event_frame(events, self.T_REF_US, table, poses, CAMERA, config, detect)
        assert len(frame.events) == len(t_us)
        return frame, now

    def test_far_points_return_to_their_place(self):
        t_us = self.T_REF_US + np.arange(-20_000, 20_000, 400)
        frame, now = self.compensated(t_us, slot_us=1)
        # float32 near 160 px resolves 1.5e-5 px; table and result are both rounded to it.
        np.testing.assert_allclose(frame.compensated_px, now, rtol=0, atol=6e-5)
        assert np.abs(frame.ideal_px - now).max() > 0.1

    def test_the_error_of_a_slot_is_the_turn_within_half_of_it(self):
        t_us = self.T_REF_US + np.arange(-20_000, 20_000, 400)
        frame, now = self.compensated(t_us, slot_us=500)
        ahead = np.array([[0.0, 0.0, 1.0]])
        R = trajectory().interpolate(self.T_REF_US + np.array([0, 250])).rotation
        half_slot_px = np.linalg.norm(np.subtract(*seen(ahead, R)))
        # Off the axis the image of a turn is larger: by 1 + tan^2 of the angle, and by the roll.
        error_px = np.linalg.norm(frame.compensated_px - now, axis=1)
        assert np.median(error_px) < half_slot_px < error_px.max() + 1e-4 < 1.7 * half_slot_px

    def test_without_compensation_events_stay_where_they_were(self):
        t_us = self.T_REF_US + np.arange(-20_000, 20_000, 400)
        frame, _ = self.compensated(t_us, slot_us=500, compensate_rotation=False)
        np.testing.assert_array_equal(frame.compensated_px, frame.ideal_px)

    def test_a_window_without_events_is_a_frame_without_events(self):
        frame, _ = self.compensated(np.empty(0, np.int64), slot_us=500)
        assert frame.compensated_px.shape == (0, 2)
        assert list(event_images(frame, DetectConfig())) == []


class TestFixedOrder:
    @settings(max_examples=50, deadline=None)
    @given(st.integers(0, 100), st.sampled_from([1, 3, 40]), st.integers(0, 1_000))
    def test_events_of_one_time_are_ordered_by_pixel_and_polarity(self, count, times, draw):
        rng = np.random.default_rng(draw)
        t_us = np.sort(rng.integers(0, times, count))
        x, y = rng.integers(0, 4, count), rng.integers(65_530, 65_536, count)
        polarity = rng.choice([-1, 1], count)
        order = frames_kernels.fixed_order(
            t_us, x.astype(np.uint16), y.astype(np.uint16), polarity.astype(np.int8)
        )
        rows = np.column_stack([t_us, y, x, polarity])
        np.testing.assert_array_equal(rows[order], rows[np.lexsort([polarity, x, y, t_us])])


class TestUndistortion:
    # Past its fold at a radius of 0.58 this lens has no answer: the corners of the image.
    FOLDING = Camera(
        width=160,
        height=120,
        fx_px=100.0,
        fy_px=100.0,
        cx_px=79.5,
        cy_px=59.5,
        model=CameraModel.PINHOLE,
        distortion=(-1.0, 0.0, 0.0, 0.0),
    )

    def test_pixels_without_a_ray_reach_neither_image_nor_window_of_others(self):
        table = undistortion_table(self.FOLDING)
        assert np.isnan(table[0, 0]).all()
        assert np.isfinite(table[60, 80]).all()
        events = stream([500_000] * 2, x=[0, 80], y=[0, 60])
        frame = event_frame(
            events, 500_000, table, trajectory(), self.FOLDING, FramesConfig(), DetectConfig()
        )
        assert np.isnan(frame.compensated_px[0]).all()
        images = event_images(frame, DetectConfig(representations=("binary",), blur_px=0.0))
        # Turned by the 0.25 ms between the middle of the slot and the frame: far below a pixel.
        assert [np.argwhere(image.grey).tolist() for image in images] == [[[60, 80]]] * 2

    def test_a_pixel_of_an_ideal_camera_is_its_own(self):
        columns, rows = np.meshgrid(np.arange(160), np.arange(120))
        np.testing.assert_allclose(
            undistortion_table(CAMERA), np.stack([columns, rows], axis=-1), rtol=0, atol=1e-5
        )


def test_frames_carry_the_poses_at_their_times():
    poses = trajectory()
    frames = frames_at(np.array([100_000, 333_333]), poses, CAMERA)
    expected = poses.interpolate(frames.t_us)
    np.testing.assert_array_equal(frames.T_world_camera.matrix(), expected.matrix())
    assert len(frames) == 2
    assert frames.focal_px == pytest.approx(120.0)


@settings(max_examples=20)
@given(st.floats(0.0, 0.3), st.floats(0.0, 0.3))
def test_turning_camera_and_time_alike_keeps_compensation(x_rad, y_rad):
    """Compensation depends on the turn between two times alone, not on the world's axes."""
    t_us = 500_000 + np.arange(-20_000, 20_000, 2_000)
    events = stream(t_us, x=np.arange(len(t_us)) * 5, y=np.arange(len(t_us)) * 3)
    table = undistortion_table(CAMERA)
    poses = trajectory()
    turn = SE3(rotation=rotation_from_vector(np.array([x_rad, y_rad, 0.1])), translation=np.ones(3))
    turned = Trajectory(t_us=poses.t_us, T_world_camera=turn @ poses.T_world_camera)
    frames = [
        event_frame(events, 500_000, table, path, CAMERA, FramesConfig(), DetectConfig())
        for path in (poses, turned)
    ]
    # float32 positions near 160 px.
    np.testing.assert_allclose(
        frames[0].compensated_px, frames[1].compensated_px, rtol=0, atol=6e-5
    )
