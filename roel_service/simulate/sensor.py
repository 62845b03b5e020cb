"""An event sensor: contrast thresholds that differ from pixel to pixel, dead time and noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roel_service.arrays import Array
from roel_service.scene.events import EventStream
from roel_service.simulate import sensor_kernels

# Intensities below this are as good as black; keeps the logarithm finite.
DARK = 0.02


@dataclass(frozen=True, kw_only=True)
class SensorModel:
    """What makes one sensor differ from an ideal one.

    Attributes:
        threshold: mean contrast of an event, in natural log intensity.
        threshold_mismatch: its standard deviation from pixel to pixel.
        refractory_us: a pixel is silent for this long after an event.
        shot_noise_hz: random events of every pixel.
        hot_pixel_share, hot_pixel_hz: some pixels fire far more often.
    """

    threshold: float = 0.3
    threshold_mismatch: float = 0.035
    refractory_us: float = 300.0
    shot_noise_hz: float = 0.5
    hot_pixel_share: float = 2e-4
    hot_pixel_hz: float = 80.0


class EventSensor:
    """Turns pictures into events, one interval after the other."""

    def __init__(self, model: SensorModel, first: Array, rng: np.random.Generator) -> None:
        """Start at time 0 with the (H, W) linear intensity `first`."""
        height, width = first.shape
        drawn = rng.normal(model.threshold, model.threshold_mismatch, size=(2, height, width))
        self._threshold = np.maximum(drawn, 0.25 * model.threshold)
        self._model = model
        self._rng = rng
        self._before = _log_intensity(first)
        # Every pixel begins somewhere between two events, not all of them at once.
        offset = rng.uniform(-0.5, 0.5, size=(height, width)) * model.threshold
        self._reference = self._before + offset
        self._last_us = np.full((height, width), -np.inf)
        hot = rng.random((height, width)) < model.hot_pixel_share
        noise_hz = np.where(hot, model.hot_pixel_hz, model.shot_noise_hz)
        self._noise_total_hz = np.cumsum(noise_hz.ravel())
        self._now_us = 0

    def advance(self, picture: Array, stop_us: int) -> EventStream:
        """Events from now until `stop_us`, when the (H, W) linear intensity is `picture`."""
        height, width = picture.shape
        level = _log_intensity(picture)
        t_us, x, y, polarity = sensor_kernels.emit(
            level,
            float(self._now_us),
            float(stop_us),
            self._threshold,
            self._model.refractory_us,
            self._before,
            self._reference,
            self._last_us,
        )
        noise = self._noise(stop_us, width)
        times = np.concatenate([t_us.astype(np.int64), noise[0]])
        order = np.argsort(times, kind="stable")
        self._now_us = stop_us
        return EventStream(
            t_us=times[order],
            x=np.concatenate([x, noise[1]])[order],
            y=np.concatenate([y, noise[2]])[order],
            polarity=np.concatenate([polarity, noise[3]])[order],
            width=width,
            height=height,
        )

    def _noise(self, stop_us: int, width: int) -> tuple[Array, Array, Array, Array]:
        """Random events until `stop_us`: times, columns, rows and polarities."""
        duration_s = (stop_us - self._now_us) * 1e-6
        count = int(self._rng.poisson(self._noise_total_hz[-1] * duration_s))
        drawn_hz = self._rng.uniform(0.0, self._noise_total_hz[-1], size=count)
        pixel = np.searchsorted(self._noise_total_hz, drawn_hz, side="right")
        return (
            self._rng.integers(self._now_us, stop_us, size=count),
            (pixel % width).astype(np.uint16),
            (pixel // width).astype(np.uint16),
            self._rng.choice(np.array([-1, 1], np.int8), size=count),
        )


def _log_intensity(picture: Array) -> Array:
    return np.log(np.maximum(picture.astype(np.float64), DARK))
