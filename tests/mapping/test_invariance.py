"""What must not change the map: workers, the order of events of one time, clock and world frame."""

import dataclasses

import numpy as np
import pytest

from roel_service.config.presets import preset
from roel_service.config.stages import (
    Config,
    DetectConfig,
    FramesConfig,
    PlaneFitConfig,
    RuntimeConfig,
    TrimConfig,
)
from roel_service.geometry.se3 import SE3, rotation_from_vector
from roel_service.mapping.pipeline import build_line_map
from roel_service.scene.events import EventStream
from roel_service.scene.trajectory import Trajectory

from .synthetic import CAMERA, event_stream, trajectory

FRAMES = FramesConfig(rate_hz=15.0)
# As in test_pipeline: the image is a quarter as wide as those that the defaults are for.
DEFAULT = Config(
    frames=FRAMES,
    plane_fit=PlaneFitConfig(extension_px=6.0, max_gap_bin_count=1),
    trim=TrimConfig(max_error_m=0.2),
)
PAPER = dataclasses.replace(
    preset("paper"),
    frames=dataclasses.replace(preset("paper").frames, rate_hz=15.0),
    plane_fit=dataclasses.replace(preset("paper").plane_fit, trial_count=32),
    triangulate=dataclasses.replace(preset("paper").triangulate, min_inlier_count=5),
)
# What draws most at random, and what follows the events one by one.
DIRECT = dataclasses.replace(
    PAPER,
    detect=DetectConfig(representations=("tos",)),
    plane_fit=dataclasses.replace(
        PAPER.plane_fit, method="direct", trial_count=8, cluster_time_scale_px_per_ms=0.2
    ),
)
CONFIGS = pytest.mark.parametrize(
    "config", [DEFAULT, PAPER, DIRECT], ids=["default", "paper", "direct"]
)
# Many events share a time, as behind the clock of a real sensor.
TICK_US = 250


def changed(events, **columns):
    return EventStream(
        **{
            name: columns.get(name, getattr(events, name))
            for name in ("t_us", "x", "y", "polarity", "width", "height")
        }
    )


@pytest.fixture(scope="module")
def events():
    stream = event_stream()
    ticking = changed(stream, t_us=stream.t_us // TICK_US * TICK_US)
    sharing = np.mean(np.diff(ticking.t_us) == 0)
    assert sharing > 0.5
    return ticking


def built(events, config, poses=None, worker_count=1):
    config = dataclasses.replace(config, runtime=RuntimeConfig(worker_count=worker_count))
    result = build_line_map(events, poses or trajectory(), CAMERA, config)
    assert len(result.line_map) > 4
    return result


@pytest.fixture(scope="module")
def maps(events):
    """The map of each configuration, built once."""
    found = {}

    def line_map(config):
        if id(config) not in found:
            found[id(config)] = built(events, config).line_map
        return found[id(config)]

    return line_map


def assert_same_map(found, expected):
    assert len(found) == len(expected)
    along = found.segments[:, 1] - found.segments[:, 0]
    against = np.vecdot(along, expected.segments[:, 1] - expected.segments[:, 0]) < 0
    # Lines have no direction.
    turned = np.where(against[:, None, None], found.segments[:, ::-1], found.segments)
    # Scenes of some metres; a line is as exact as its 4x4 system, 1e-10 of that.
    np.testing.assert_allclose(turned, expected.segments, rtol=0, atol=1e-7)
    np.testing.assert_array_equal(found.observation_count, expected.observation_count)
    np.testing.assert_allclose(found.sigma_m, expected.sigma_m, rtol=1e-5)
    np.testing.assert_allclose(found.rms_residual_px, expected.rms_residual_px, rtol=1e-4)


@CONFIGS
def test_worker_count_does_not_matter(maps, events, config):
    found = built(events, config, worker_count=3).line_map
    for name, column in vars(maps(config)).items():
        np.testing.assert_array_equal(column, getattr(found, name))


@CONFIGS
def test_order_of_events_of_one_time_does_not_matter(maps, events, config):
    rng = np.random.default_rng(1)
    order = np.lexsort([rng.random(len(events)), events.t_us])
    columns = {name: getattr(events, name)[order] for name in ("x", "y", "polarity")}
    assert (columns["x"] != events.x).mean() > 0.3
    found = built(changed(events, **columns), config).line_map
    assert_same_map(found, maps(config))


@CONFIGS
@pytest.mark.parametrize("shift_us", [-700_001, 1_700_000_000_123_457])
def test_the_clock_does_not_matter(maps, events, config, shift_us):
    poses = trajectory()
    shifted = Trajectory(t_us=poses.t_us + shift_us, T_world_camera=poses.T_world_camera)
    found = built(changed(events, t_us=events.t_us + shift_us), config, shifted).line_map
    assert_same_map(found, maps(config))


@CONFIGS
def test_the_map_moves_with_the_world(maps, events, config):
    T_moved_world = SE3(
        rotation=rotation_from_vector(np.array([0.4, -1.1, 2.0])),
        translation=np.array([30.0, -20.0, 10.0]),
    )
    poses = trajectory()
    moved = Trajectory(t_us=poses.t_us, T_world_camera=T_moved_world @ poses.T_world_camera)
    found = built(events, config, moved).line_map
    assert_same_map(found, maps(config).transformed(T_moved_world))
