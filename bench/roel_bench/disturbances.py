"""What makes a recording harder: noise, uneven thresholds, low light, fast motion, other poses.

Each disturbance takes a scene and gives another one that is read from the first as it goes, so
that recordings larger than memory can be disturbed too. The same seed gives the same events.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from roel_bench.scenes import Scene, part_of
from roel_service.errors import InputError
from roel_service.scene.events import EventSource, EventStream
from roel_service.scene.trajectory import Trajectory

# The paper injects noise events of this share of the clean ones.
NOISE_SHARE = 0.15
# Low light: this share of the events is left.
LOW_LIGHT_SHARE = 0.3
# Natural logarithm of how much higher a pixel's threshold is, one draw a pixel and polarity.
THRESHOLD_SIGMA = 0.3
# Fast motion: the same way in this part of the time.
SPEED_UP = 2

# One chunk, changed with its own stream of chance.
Change = Callable[[EventStream, np.random.Generator], EventStream]


@dataclass(frozen=True, eq=False, kw_only=True)
class ChangedEvents:
    """An `EventSource` that changes the chunks of another one.

    Attributes:
        source: must give the same chunks whenever it is read.
        change: called for each chunk that holds events.
        seed: each chunk draws from the stream of this seed and its own number.
        time_divisor: what `change` divides times by.
    """

    source: EventSource
    change: Change
    seed: int
    time_divisor: int = 1

    @property
    def width(self) -> int:
        return self.source.width

    @property
    def height(self) -> int:
        return self.source.height

    @property
    def time_range_us(self) -> tuple[int, int] | None:
        ends = self.source.time_range_us
        return ends and (ends[0] // self.time_divisor, ends[1] // self.time_divisor)

    def chunks(self) -> Iterator[EventStream]:
        for index, chunk in enumerate(self.source.chunks()):
            if len(chunk):
                sequence = np.random.SeedSequence(self.seed, spawn_key=(index,))
                yield self.change(chunk, np.random.default_rng(sequence))


def with_noise(scene: Scene, seed: int) -> Scene:
    """Noise events, uniform in space and time, `NOISE_SHARE` of the clean ones [paper, IV-H]."""
    count, duration_us = _count_and_duration_us(scene.events)
    per_us = NOISE_SHARE * count / duration_us

    def add(chunk: EventStream, rng: np.random.Generator) -> EventStream:
        first_us, last_us = int(chunk.t_us[0]), int(chunk.t_us[-1])
        noise_count = int(rng.poisson(per_us * (last_us - first_us)))
        t_us = np.concatenate([chunk.t_us, rng.integers(first_us, last_us + 1, noise_count)])
        order = np.argsort(t_us, kind="stable")
        x = np.concatenate([chunk.x, rng.integers(0, chunk.width, noise_count)])
        y = np.concatenate([chunk.y, rng.integers(0, chunk.height, noise_count)])
        polarity = np.concatenate([chunk.polarity, rng.choice([-1, 1], noise_count)])
        return EventStream(
            t_us=t_us[order],
            x=x[order],
            y=y[order],
            polarity=polarity[order],
            width=chunk.width,
            height=chunk.height,
        )

    return _with_events(scene, add, seed)


def with_uneven_thresholds(scene: Scene, seed: int) -> Scene:
    """Pixels and polarities whose threshold is higher, and which send fewer events for it.

    A recording cannot be given events it does not hold; so the most sensitive pixels stay as they
    are, and the others keep the share of their events that the ratio of the thresholds allows.
    """
    shape = (2, scene.camera.height, scene.camera.width)
    ratio = np.exp(np.abs(np.random.default_rng(seed).normal(scale=THRESHOLD_SIGMA, size=shape)))

    def thin(chunk: EventStream, rng: np.random.Generator) -> EventStream:
        kept_share = 1.0 / ratio[(chunk.polarity > 0).astype(np.intp), chunk.y, chunk.x]
        return part_of(chunk, rng.random(len(chunk)) < kept_share)

    return _with_events(scene, thin, seed)


def with_low_light(scene: Scene, seed: int) -> Scene:
    """Only `LOW_LIGHT_SHARE` of the events, drawn at random."""

    def thin(chunk: EventStream, rng: np.random.Generator) -> EventStream:
        return part_of(chunk, rng.random(len(chunk)) < LOW_LIGHT_SHARE)

    return _with_events(scene, thin, seed)


def with_fast_motion(scene: Scene, seed: int) -> Scene:
    """The same events and poses in half the time; frames stay 30 a second, so there are fewer."""

    def hurry(chunk: EventStream, rng: np.random.Generator) -> EventStream:
        return dataclasses.replace(chunk, t_us=chunk.t_us // SPEED_UP)

    def hurried(trajectory: Trajectory | None) -> Trajectory | None:
        if trajectory is None:
            return None
        return dataclasses.replace(trajectory, t_us=trajectory.t_us // SPEED_UP)

    events = ChangedEvents(source=scene.events, change=hurry, seed=seed, time_divisor=SPEED_UP)
    return dataclasses.replace(
        scene,
        events=events,
        trajectory=hurried(scene.trajectory),
        noisy_trajectory=hurried(scene.noisy_trajectory),
    )


def with_noisy_poses(scene: Scene, seed: int) -> Scene:
    """The scene's own noisy poses in place of the true ones; truth stays where it is.

    Raises:
        InputError: the scene has none.
    """
    if scene.noisy_trajectory is None:
        raise InputError(scene.name, "a scene with noisy poses", "none")
    return dataclasses.replace(scene, trajectory=scene.noisy_trajectory)


Disturbance = Callable[[Scene, int], Scene]

NOISY_POSES = "noisy_poses"
DISTURBANCES: dict[str, Disturbance] = {
    "noise_events": with_noise,
    "uneven_thresholds": with_uneven_thresholds,
    "low_light": with_low_light,
    "fast_motion": with_fast_motion,
    NOISY_POSES: with_noisy_poses,
}


def _with_events(scene: Scene, change: Change, seed: int) -> Scene:
    events = ChangedEvents(source=scene.events, change=change, seed=seed)
    return dataclasses.replace(scene, events=events)


def _count_and_duration_us(events: EventSource) -> tuple[int, int]:
    """Number of events and the time between the first and the last, by reading them."""
    count, first_us, last_us = 0, None, 0
    for chunk in events.chunks():
        if len(chunk):
            count += len(chunk)
            first_us = int(chunk.t_us[0]) if first_us is None else first_us
            last_us = int(chunk.t_us[-1])
    return count, max(1, last_us - (first_us or 0))
