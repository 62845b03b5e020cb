import dataclasses

import numpy as np
import pytest

from roel_service.config.stages import Config, CurvesConfig, FramesConfig
from roel_service.geometry import projection
from roel_service.mapping import curves
from roel_service.mapping.curve_pieces import FRAME_STEP
from roel_service.mapping.frames import frames_at, velocities
from roel_service.scene.lines import LineMap, LineObservations

from .synthetic import CAMERA, DURATION_US, in_image, normal_speeds, trajectory

NO_LINES = LineMap.from_segments(np.empty((0, 2, 3)))
RADIUS_M = 0.5
# The image is a quarter as wide as those that the defaults are for: pieces are as short as pixels
# allow, and a pixel of noise is four times as far.
CONFIG = Config(
    frames=FramesConfig(rate_hz=30.0),
    curves=CurvesConfig(method="polyline", max_sigma_m=0.4, min_frame_count=6, frame_stride=9),
)


def ring(count=60, radius_m=RADIUS_M):
    """(count, 2, 3) short sides of a circle that is seen askew, m."""
    angle = np.linspace(0, 2 * np.pi, count + 1)
    points = radius_m * np.stack([np.cos(angle), 0.8 * np.sin(angle), 0.6 * np.sin(angle)], axis=-1)
    return np.stack([points[:-1], points[1:]], axis=1)


def seen(segments, frame_count=60, noise_px=0.0):
    """Pieces of the edges in every frame that has any, and the frames."""
    poses = trajectory()
    t_us = np.linspace(20_000, DURATION_US - 20_000, frame_count).astype(np.int64)
    frames = frames_at(t_us, poses, CAMERA)
    in_camera = frames.T_world_camera.inverse()[:, None, None] @ segments
    ends_px = projection.project(in_camera, frames.K)
    visible = in_image(ends_px)
    visible[np.arange(frame_count) % FRAME_STEP != 0] = False
    frame, line = np.nonzero(visible)
    speeds = normal_speeds(ends_px[frame, line], in_camera[frame, line], frame, poses, frames)
    noise = noise_px * np.random.default_rng(0).standard_normal((len(frame), 1, 2))
    pieces = LineObservations(
        frame=frame,
        segments_px=ends_px[frame, line] + noise,
        polarity=np.ones(len(frame), np.int8),
        normal_speed_px_per_ms=speeds,
        event_offsets=np.zeros(len(frame) + 1, np.int64),
        event_xy_px=np.empty((0, 2), np.float32),
        event_dt_us=np.empty(0, np.int32),
    )
    return pieces, frames


def mapped(pieces, frames, line_map=NO_LINES, **changes):
    config = dataclasses.replace(CONFIG, curves=dataclasses.replace(CONFIG.curves, **changes))
    return curves.with_curves(
        line_map, pieces, frames, trajectory(), config, lambda done, total: None
    )


def distances_m(points, segments):
    return curves.point_segment_distance(points[:, None], segments[None]).min(axis=1)


@pytest.fixture(scope="module")
def sight():
    return seen(ring(), noise_px=0.05)


@pytest.fixture(scope="module")
def found(sight):
    return mapped(*sight)


def test_a_ring_is_mapped(found):
    truth = ring()
    # A pixel is 21 mm.
    assert np.median(distances_m(found.segments.mean(axis=1), truth)) < 0.01
    # Where the ring runs along the camera's motion nothing tells how deep it is.
    covered = distances_m(truth.mean(axis=1), found.segments) < 0.021
    assert covered.mean() > 0.5
    assert (found.observation_count >= CONFIG.curves.min_frame_count).all()
    assert (found.rms_residual_px <= CONFIG.curves.max_rms_px).all()
    assert (found.sigma_m > 0).all()


def test_an_arc_is_mapped_as_a_bezier_curve():
    arc = ring()[10:28]
    found = mapped(*seen(arc, noise_px=0.05), method="bezier")
    assert np.median(distances_m(found.segments.mean(axis=1), arc)) < 0.01
    assert (distances_m(arc.mean(axis=1), found.segments) < 0.021).mean() > 0.5


def test_lines_stay_and_nothing_is_mapped_along_them(sight, found):
    lines = LineMap.from_segments(found.segments)
    again = mapped(*sight, line_map=lines)
    np.testing.assert_array_equal(again.segments[: len(lines)], lines.segments)
    assert len(again) - len(lines) < 0.3 * len(lines)


def test_without_pieces_the_map_stays_as_it_is(sight):
    pieces, frames = sight
    none = dataclasses.replace(
        pieces,
        frame=pieces.frame[:0],
        segments_px=pieces.segments_px[:0],
        polarity=pieces.polarity[:0],
        normal_speed_px_per_ms=pieces.normal_speed_px_per_ms[:0],
        event_offsets=np.zeros(1, np.int64),
    )
    assert mapped(none, frames) is NO_LINES


def test_a_camera_in_one_place_finds_no_depth():
    pieces, frames = seen(ring())
    still = dataclasses.replace(
        frames,
        T_world_camera=dataclasses.replace(
            frames.T_world_camera, translation=np.zeros((len(frames), 3))
        ),
    )
    assert len(mapped(pieces, still)) == 0


def test_speeds_that_hold_the_rotation_are_not_asked(sight):
    pieces, frames = sight
    wrong = dataclasses.replace(pieces, normal_speed_px_per_ms=np.full(len(pieces), 10.0))
    raw = dataclasses.replace(CONFIG, frames=FramesConfig(compensate_rotation=False))
    for config, count in ((CONFIG, 0), (raw, 1)):
        found = curves.with_curves(
            NO_LINES, wrong, frames, trajectory(), config, lambda done, total: None
        )
        assert min(len(found), 1) == count


def test_vertices_keep_all_points_within_the_error():
    angle = np.linspace(0, np.pi, 50)
    points = np.stack([np.cos(angle), np.sin(angle), np.zeros(50)], axis=-1)
    column = np.zeros(50)
    curve = curves._Curve(
        points=points,
        pixel_m=np.full(50, 0.01),
        frame_count=np.ones(50, np.int64),
        rms_px=column,
        sigma_m=column,
    )
    kept = curves._vertices(curve, max_error_px=1.0)
    assert kept[0] == 0
    assert kept[-1] == 49
    # Chords 1 cm from a half circle of 1 m span 0.28 rad: eleven of them at the least.
    assert 11 <= len(kept) - 1 <= 22
    segments = np.stack([points[kept[:-1]], points[kept[1:]]], axis=1)
    assert distances_m(points, segments).max() <= 0.01


@pytest.mark.parametrize("basis", [curves._bernstein, curves._hats])
def test_weights_of_control_points_sum_to_one(basis):
    weights = basis(np.linspace(0, 1, 17))
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    np.testing.assert_allclose(weights[0], np.eye(weights.shape[1])[0])
    np.testing.assert_allclose(weights[-1], np.eye(weights.shape[1])[-1])


def test_velocities_are_those_of_the_path():
    poses = trajectory()
    frames = frames_at(np.array([500_000]), poses, CAMERA)
    ends = poses.interpolate(np.array([490_000, 510_000])).translation
    np.testing.assert_allclose(velocities(frames, poses)[0], (ends[1] - ends[0]) / 0.02, atol=1e-2)
