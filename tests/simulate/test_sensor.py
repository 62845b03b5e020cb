import numpy as np
import pytest

from roel_service.scene.events import EventStream, concatenate
from roel_service.simulate.render import render
from roel_service.simulate.scenes import texture_atlas
from roel_service.simulate.sensor import EventSensor, SensorModel

from .samples import DEPTH_M, FOCAL_PX, HEIGHT, WIDTH, K, at, wall_with_edge

GREY = np.full((HEIGHT, WIDTH), 0.5, np.float32)
QUIET = SensorModel(shot_noise_hz=0.0, hot_pixel_share=0.0)


def events_of_rest(model: SensorModel, seed: int = 0, seconds: float = 1.0) -> EventStream:
    sensor = EventSensor(model, GREY, np.random.default_rng(seed))
    stops_us = np.linspace(0, seconds * 1e6, 11).astype(int)[1:]
    return concatenate([sensor.advance(GREY, int(stop_us)) for stop_us in stops_us])


def test_a_sensor_without_noise_at_rest_sends_nothing():
    assert len(events_of_rest(QUIET)) == 0


def test_noise_has_the_rate_of_the_model():
    events = events_of_rest(SensorModel(shot_noise_hz=2.0, hot_pixel_share=0.0))
    expected = 2.0 * WIDTH * HEIGHT
    # Five standard deviations of a Poisson count.
    assert abs(len(events) - expected) < 5 * np.sqrt(expected)
    assert abs(events.polarity.mean()) < 5 / np.sqrt(len(events))


def test_hot_pixels_are_few_and_fire_at_their_rate():
    events = events_of_rest(
        SensorModel(shot_noise_hz=0.0, hot_pixel_share=0.01, hot_pixel_hz=100.0)
    )
    pixels, counts = np.unique(events.y.astype(int) * WIDTH + events.x, return_counts=True)
    share = len(pixels) / (WIDTH * HEIGHT)
    assert abs(share - 0.01) < 5 * np.sqrt(0.01 / (WIDTH * HEIGHT))
    assert abs(counts.mean() - 100.0) < 5 * np.sqrt(100.0 / len(pixels))


def test_equal_seeds_give_equal_events_and_others_do_not():
    first, same, other = (events_of_rest(SensorModel(), seed) for seed in (1, 1, 2))
    for column in ("t_us", "x", "y", "polarity"):
        np.testing.assert_array_equal(getattr(first, column), getattr(same, column))
    assert len(first) != len(other) or (first.t_us != other.t_us).any()


def test_thresholds_differ_from_pixel_to_pixel_as_much_as_the_model_says():
    # A slow ramp over 40 mean thresholds: each pixel counts its own threshold off.
    steps = 40
    model = SensorModel(
        threshold=0.05, threshold_mismatch=0.005, shot_noise_hz=0.0, hot_pixel_share=0.0
    )
    dark = np.full((HEIGHT, WIDTH), 0.1, np.float32)
    sensor = EventSensor(model, dark, np.random.default_rng(3))
    events = sensor.advance(dark * np.float32(np.exp(steps * model.threshold)), 1_000_000)
    counts = np.bincount(events.y.astype(int) * WIDTH + events.x, minlength=WIDTH * HEIGHT)
    measured = steps * model.threshold / counts
    # Counting is good to half an event in 40, 0.4 % of the threshold besides the mismatch of 10 %.
    assert measured.mean() == pytest.approx(0.05, rel=0.02)
    assert measured.std() == pytest.approx(0.005, rel=0.15)


@pytest.mark.parametrize("angle_rad", [0.0, 0.4, np.pi / 2])
def test_events_lie_on_the_edge_that_causes_them(angle_rad):
    """The mean over both directions of motion; what is left is the logarithm's.

    A pixel's mean intensity is linear in the place of the edge, its logarithm is not: half of the
    contrast of a 1:2 edge is reached when sqrt(2) - 1 = 0.41 of the pixel is bright, 0.09 px early.
    """
    normal = np.array([np.cos(angle_rad), np.sin(angle_rad)])
    there, back = (mean_distance_px(normal, speed) for speed in (300.0, -300.0))
    # 0.09 px of the logarithm, up to half a threshold's share of the pixel on each way, which
    # cancels in the mean, and 1/12 px of the renderer's samples.
    assert abs(there + back) / 2 < 0.15
    assert abs(there - back) / 2 < 0.25


def mean_distance_px(normal: np.ndarray, speed_px_s: float) -> float:
    """Mean signed distance of events from a moving edge at their own times."""
    scene = wall_with_edge(normal)
    atlas = texture_atlas(scene.textures, grey=True)
    duration_us = 60_000
    speed_m_us = speed_px_s * 1e-6 * DEPTH_M / FOCAL_PX

    def moved_m(t_us):
        return (t_us - duration_us / 2) * speed_m_us

    def picture(t_us):
        pose = at(*(moved_m(t_us) * normal), 0.0)
        return render(scene, atlas, pose, K, WIDTH, HEIGHT)[..., 0]

    sensor = EventSensor(QUIET, picture(0), np.random.default_rng(0))
    times_us = range(2_000, duration_us + 1, 2_000)
    events = concatenate([sensor.advance(picture(t_us), t_us) for t_us in times_us])
    edge_px = -moved_m(events.t_us) * FOCAL_PX / DEPTH_M
    xy_px = np.stack([events.x - K[0, 2], events.y - K[1, 2]], axis=-1)
    distance_px = xy_px @ normal - edge_px
    # A pixel's corner, and the way of the edge between two pictures.
    assert np.abs(distance_px).max() < np.sqrt(0.5) + 0.6
    return float(distance_px.mean())
