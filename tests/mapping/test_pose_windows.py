import itertools

import numpy as np
import pytest

from roel_service.config.stages import RefineConfig
from roel_service.geometry.se3 import SE3
from roel_service.mapping.front_end import Detected
from roel_service.mapping.plane_fit import NO_LINES, observations_of_frames
from roel_service.mapping.pose_windows import laid_over, pose_windows, seen_between
from roel_service.mapping.time_offset import TimeOffset, mean_offset
from roel_service.scene.trajectory import Trajectory

from .synthetic import world

CONFIG = RefineConfig()


def still(t_us):
    t_us = np.asarray(t_us, np.int64)
    poses = SE3(
        rotation=np.tile(np.eye(3), (len(t_us), 1, 1)), translation=np.zeros((len(t_us), 3))
    )
    return Trajectory(t_us=t_us, T_world_camera=poses)


def seconds(trajectory, window):
    return np.ptp(trajectory.t_us[window]) * 1e-6


class TestWindows:
    def test_what_fits_is_one_window(self):
        short = still(np.arange(0, 102_000_000, 50_000))
        assert pose_windows(short, CONFIG) == [slice(0, len(short))]

    def test_a_long_recording_is_covered_by_windows_that_overlap(self):
        long = still(np.arange(0, 300_000_000, 50_000))
        windows = pose_windows(long, CONFIG)
        assert (windows[0].start, windows[-1].stop) == (0, len(long))
        assert max(seconds(long, window) for window in windows) <= 51.2
        for one, next_one in itertools.pairwise(windows):
            # Four times the 1.5 s after which a drift is forgotten.
            both = seconds(long, slice(next_one.start, one.stop))
            assert both == pytest.approx(6.0, abs=0.11)

    def test_a_gap_leaves_no_window_without_poses(self):
        apart = still([0, 50_000, 100_000, *np.arange(150_000_000, 200_000_000, 50_000)])
        windows = pose_windows(apart, CONFIG)
        assert all(window.stop - window.start >= 2 for window in windows)
        covered = np.concatenate([np.arange(len(apart))[window] for window in windows])
        assert set(covered) == set(range(len(apart)))


def test_what_was_seen_in_a_time_is_that_of_its_frames():
    exact = world()
    whole = Detected(
        frames=exact.frames,
        observations=exact.observations,
        evidence=exact.evidence(RefineConfig(event_weight=0.0)),
        pieces=observations_of_frames([NO_LINES]),
        images={},
    )
    part = seen_between(whole, int(exact.frames.t_us[5]), int(exact.frames.t_us[9]))
    assert len(part.frames) == 5
    rows = np.isin(exact.observations.frame, np.arange(5, 10))
    np.testing.assert_array_equal(part.observations.frame, exact.observations.frame[rows] - 5)
    np.testing.assert_array_equal(
        part.observations.segments_px, exact.observations.segments_px[rows]
    )
    np.testing.assert_array_equal(part.evidence.views.normal, whole.evidence.views.normal[rows])
    np.testing.assert_array_equal(part.evidence.segment_forms, whole.evidence.segment_forms[rows])


class TestLaidOver:
    def test_one_window_fades_into_the_next(self):
        t_us = np.arange(0, 100, 10)
        windows = [slice(0, 7), slice(3, 10)]
        shifts = (0.0, 3.0)
        poses = [
            SE3(
                rotation=np.tile(np.eye(3), (7, 1, 1)),
                translation=np.broadcast_to([shift, 0.0, 0.0], (7, 3)),
            )
            for shift in shifts
        ]
        covariances = [np.broadcast_to((1.0 + shift) * np.eye(6), (7, 6, 6)) for shift in shifts]
        found, covariance = laid_over(t_us, windows, poses, covariances)
        expected = [0, 0, 0, 0, 1, 2, 3, 3, 3, 3]
        np.testing.assert_allclose(found.translation[:, 0], expected, atol=1e-12)
        np.testing.assert_allclose(covariance[:, 0, 0], 1.0 + np.array(expected), atol=1e-12)

    def test_one_window_stays_as_it_is(self):
        t_us = np.arange(5)
        poses = still(t_us).T_world_camera
        found, covariance = laid_over(t_us, [slice(0, 5)], [poses], [np.ones((5, 6, 6))])
        np.testing.assert_array_equal(found.matrix(), poses.matrix())
        assert (covariance == 1.0).all()


def test_offsets_of_windows_count_as_they_are_sure():
    sure, unsure = (TimeOffset(offset_us=o, sigma_us=s) for o, s in ((10.0, 1.0), (20.0, 2.0)))
    mean = mean_offset([sure, unsure])
    assert mean.offset_us == pytest.approx(12.0)
    assert mean.sigma_us == pytest.approx(0.8**0.5)
    unknown = TimeOffset(offset_us=5.0, sigma_us=float("inf"))
    assert mean_offset([unknown]).sigma_us == float("inf")
    assert mean_offset([unknown, sure]) == sure
