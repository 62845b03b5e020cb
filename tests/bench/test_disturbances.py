import numpy as np
import pytest

from roel_bench.disturbances import (
    DISTURBANCES,
    LOW_LIGHT_SHARE,
    NOISE_SHARE,
    with_fast_motion,
    with_low_light,
    with_noise,
    with_noisy_poses,
    with_uneven_thresholds,
)
from roel_service.errors import InputError
from roel_service.scene.events import EventStream, concatenate
from tests.bench.samples import moving_camera, random_events, scene
from tests.chunked import InChunks


def events_of(disturbed):
    return concatenate(list(disturbed.events.chunks()))


def columns(events):
    return np.stack([events.t_us, events.x, events.y, events.polarity], axis=1)


@pytest.fixture
def sample():
    events = InChunks(random_events(40_000), 15_000)
    return scene(events=events, noisy_trajectory=moving_camera(speed_m_per_s=1.1))


@pytest.mark.parametrize("name", DISTURBANCES)
def test_same_seed_same_recording(sample, name):
    first = events_of(DISTURBANCES[name](sample, 3))
    second = events_of(DISTURBANCES[name](sample, 3))
    assert (columns(first) == columns(second)).all()


@pytest.mark.parametrize("make", [with_noise, with_low_light, with_uneven_thresholds])
def test_another_seed_another_recording(sample, make):
    first, second = events_of(make(sample, 3)), events_of(make(sample, 4))
    assert len(first) != len(second) or (columns(first) != columns(second)).any()


def test_noise_adds_its_share_and_keeps_every_event(sample):
    noisy = events_of(with_noise(sample, 0))
    added = len(noisy) - 40_000
    # A Poisson count of 6000 has a deviation of 77.
    assert added == pytest.approx(NOISE_SHARE * 40_000, abs=5 * 77)
    left, counts = np.unique(columns(noisy), axis=0, return_counts=True)
    wanted, wanted_counts = np.unique(columns(events_of(sample)), axis=0, return_counts=True)
    index = {tuple(event): count for event, count in zip(left, counts, strict=True)}
    assert all(
        index[tuple(event)] >= count for event, count in zip(wanted, wanted_counts, strict=True)
    )


def test_noise_is_even_in_time_where_events_are_not():
    # All events but ten in the first half.
    t_us = np.concatenate([np.linspace(0, 50_000, 19_990), np.linspace(50_001, 100_000, 10)])
    events = random_events(20_000)
    uneven = EventStream(
        t_us=t_us.astype(np.int64),
        x=events.x,
        y=events.y,
        polarity=events.polarity,
        width=events.width,
        height=events.height,
    )
    noisy = events_of(with_noise(scene(events=uneven), 0))
    late = int((noisy.t_us > 50_000).sum()) - 10
    # Half of 3000, deviation 39.
    assert late == pytest.approx(1_500, abs=5 * 39)


def test_low_light_keeps_its_share(sample):
    # Binomial: deviation 92.
    kept = len(events_of(with_low_light(sample, 0)))
    assert kept == pytest.approx(LOW_LIGHT_SHARE * 40_000, abs=5 * 92)


def test_thresholds_differ_by_pixel_and_stay():
    busy = random_events(400_000)
    disturbed = events_of(with_uneven_thresholds(scene(events=busy), 0))

    def counts(events, positive):
        chosen = (events.polarity > 0) == positive
        place = events.y[chosen].astype(int) * events.width + events.x[chosen]
        return np.bincount(place, minlength=events.width * events.height)

    kept = counts(disturbed, True) / np.maximum(1, counts(busy, True))
    other = counts(disturbed, False) / np.maximum(1, counts(busy, False))
    # About 65 events a pixel and polarity: chance alone would give a deviation of 0.06 or less.
    assert 0.6 < kept.mean() < 0.95
    assert kept.std() > 0.1
    # The two polarities of a pixel have thresholds of their own.
    assert abs(np.corrcoef(kept, other)[0, 1]) < 0.1


def test_fast_motion_halves_times_of_events_and_poses(sample):
    fast = with_fast_motion(sample, 0)
    assert (events_of(fast).t_us == events_of(sample).t_us // 2).all()
    assert (fast.trajectory.t_us == sample.trajectory.t_us // 2).all()
    assert (fast.noisy_trajectory.t_us == sample.noisy_trajectory.t_us // 2).all()
    assert fast.events.time_range_us == (
        events_of(fast).t_us[0],
        events_of(fast).t_us[-1],
    )


def test_noisy_poses_take_the_place_of_the_true_ones(sample):
    assert with_noisy_poses(sample, 0).trajectory is sample.noisy_trajectory
    with pytest.raises(InputError, match="noisy poses"):
        with_noisy_poses(scene(), 0)
