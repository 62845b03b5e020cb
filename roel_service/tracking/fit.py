"""One window of events against the lines of the map, by iterated least squares.

The unknowns are the pose in the middle of the window and the velocity, so that every event has the
pose of its own time; the motion model's forecast is their prior.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from roel_service.arrays import Array, BoolArray, FloatArray, IntArray
from roel_service.config.stages import TrackConfig
from roel_service.scene.events import EventSlice
from roel_service.tracking import fit_kernels
from roel_service.tracking.fit_kernels import (
    BESIDE,
    INNER,
    MIN_LENGTH_PX,
    Events,
    Fitted,
    Motion,
    Picture,
    Pieces,
)
from roel_service.tracking.motion import MotionState
from roel_service.tracking.pieces import MapPieces

# Events of one slot share one pose.
SLOT_US = 1_000
# Lines nearer than this share of the map's extent are cut.
MIN_DEPTH_SHARE = 0.01
# A piece that moves less than this during a window makes no events, and says nothing of what is seen.
MIN_MOTION_PX = 1.0
# With less of the lines in view moving, by length, a window says nothing about the pose.
MIN_MOVING_SHARE = 0.2
# Fewer events than this, of a pixel in a second, are noise: the camera rests. What is left of its
# motion then is about so large, in a window.
REST_HZ, REST_PX = 3.0, 0.5


@dataclass(frozen=True, eq=False, kw_only=True)
class Window:
    """Events of one short time, some of them left out where there are many.

    Attributes:
        t_us: middle of the window.
        xy_px: (K, 2) ideal pixels at the events' own times.
        after_s: (K,) times after the middle.
        slot: (K,) index into `slot_s`.
        slot_s: (S,) middles of the slots, after the middle of the window.
        span_s: length of the window.
        is_quiet: whether there are hardly any events, as from a camera at rest.
        event_count: events before some were left out.
    """

    t_us: int
    xy_px: FloatArray
    slot: IntArray
    slot_s: FloatArray
    span_s: float
    is_quiet: bool
    event_count: int

    def thinned(self, most: int) -> Window:
        """The window with `most` of its events at the most."""
        chosen = slice(0, None, max(1, -(-len(self.slot) // most)))
        # Side by side in memory, as loops expect them.
        return replace(self, xy_px=self.xy_px[chosen].copy(), slot=self.slot[chosen].copy())


@dataclass(frozen=True, kw_only=True)
class View:
    """Calibration and size of the picture.

    Attributes:
        K: (3, 3) px.
        width, height: px.
    """

    K: FloatArray
    width: int
    height: int


@dataclass(frozen=True, eq=False, kw_only=True)
class Evidence:
    """How well events and lines agree.

    Attributes:
        on_count, beside_count: events on the lines that move in the picture, and beside them.
        in_view_px: length of the lines in view.
        moving_px: length of those that move enough to be seen.
        seen_px: length of those that are seen.
        moving_px2, seen_px2: areas that both sweep, in which events are to be expected.
        seen_count: pieces that are seen.
    """

    on_count: int
    beside_count: int
    in_view_px: float
    moving_px: float
    seen_px: float
    moving_px2: float
    seen_px2: float
    seen_count: int

    @property
    def is_still(self) -> bool:
        """Whether too little moves to tell anything."""
        return self.moving_px < MIN_MOVING_SHARE * self.in_view_px

    @property
    def seen_share(self) -> float:
        """Share of the moving lines in view, by length, on which events are."""
        return self.seen_px / self.moving_px if self.moving_px > 0.0 else 0.0

    @property
    def explained_count(self) -> float:
        """Events that the lines explain, fewer where lines lack the events that they should have."""
        return self.on_count * self.seen_px2 / self.moving_px2 if self.moving_px2 > 0.0 else 0.0

    @property
    def sharpness(self) -> float:
        """Density of events on the lines against that beside them; 1 by chance."""
        beside = self.beside_count * 2.0 * INNER / (2.0 * (BESIDE[1] - BESIDE[0]))
        return self.on_count / max(beside, 1.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class WindowFit:
    """What a window says.

    Attributes:
        state: pose and velocity.
        surprise: distance of the state from the forecast, in deviations of the forecast.
        evidence: agreement of lines and events at that pose.
        seen: (P,) whether events lie along each piece.
        information: (12, 12) what the window says of a step of the state.
        information_of_edges: (E, 12, 12) what the edges that have events say each.
    """

    state: MotionState
    surprise: float
    evidence: Evidence
    seen: BoolArray
    information: FloatArray
    information_of_edges: FloatArray


def window_of(events: EventSlice, ideal_px: Array, span_us: tuple[int, int], most: int) -> Window:
    """Undistorted events of a span of time, `most` of them at the most."""
    count = len(events.t_us)
    span_s = (span_us[1] - span_us[0]) * 1e-6
    stride = -(-count // most) if count else 1
    chosen = slice(0, count, stride)
    t_us, x, y = events.t_us[chosen], events.x[chosen], events.y[chosen]
    slot_count = -(-(span_us[1] - span_us[0]) // SLOT_US)
    slot = np.minimum((t_us - span_us[0]) // SLOT_US, slot_count - 1)
    middles_us = span_us[0] + (np.arange(slot_count) + 0.5) * SLOT_US
    return Window(
        t_us=events.t_ref_us,
        xy_px=ideal_px[y, x].astype(np.float64),
        slot=slot,
        slot_s=np.asarray((middles_us - events.t_ref_us) * 1e-6, np.float64),
        span_s=span_s,
        is_quiet=count < REST_HZ * span_s * ideal_px[..., 0].size,
        event_count=count,
    )


def fit_window(
    forecast: MotionState,
    window: Window,
    pieces: MapPieces,
    view: View,
    config: TrackConfig,
    scales_px: tuple[float, ...],
    known: BoolArray | None = None,
) -> WindowFit:
    """The state in the middle of a window that suits its events and the forecast best.

    Args:
        forecast: the prior, at the window's time.
        scales_px: of the rounds: events are taken up within `REACH` times this.
        known: (P,) pieces that were seen a short time ago: no events on them say that they rest.
    """
    if window.is_quiet:
        forecast = _at_rest(forecast, window.span_s, pieces, view)
    prior_information = np.asarray(np.linalg.inv(forecast.covariance), np.float64)
    pose = forecast.T_world_camera
    fitted = fit_kernels.fitted(
        # Copies, since a loop is compiled anew for arrays that must not be written to.
        Motion(pose.rotation.copy(), pose.translation.copy(), forecast.velocity.copy()),
        prior_information,
        Events(window.xy_px, window.slot, window.slot_s, window.span_s),
        Pieces(
            pieces.segments,
            pieces.direction,
            pieces.edge,
            np.zeros(len(pieces), np.bool_) if known is None else known,
            MIN_DEPTH_SHARE * pieces.extent_m,
        ),
        Picture(
            view.K,
            view.width,
            view.height,
            config.line_noise_px,
            config.line_noise_m,
            config.event_noise_px,
        ),
        np.array(scales_px),
    )
    return WindowFit(
        state=forecast.stepped(fitted.step, fitted.covariance),
        surprise=float(np.sqrt(fitted.step @ prior_information @ fitted.step)),
        evidence=_evidence(fitted, window.span_s),
        seen=fitted.seen,
        information=fitted.information,
        information_of_edges=fitted.information_of_edges,
    )


def _at_rest(forecast: MotionState, span_s: float, pieces: MapPieces, view: View) -> MotionState:
    """The forecast, once it is known that nothing moves in the picture."""
    turn_rad = REST_PX / view.K[0, 0]
    # Lines are some share of the map's extent away.
    shift_m = 0.25 * pieces.extent_m * turn_rad
    noise = np.diag(np.square([turn_rad / span_s] * 3 + [shift_m / span_s] * 3))
    # Kalman's update by a velocity of zero.
    of_velocity = forecast.covariance[:, 6:]
    gain = of_velocity @ np.linalg.inv(forecast.covariance[6:, 6:] + noise)
    covariance = forecast.covariance - gain @ of_velocity.T
    return forecast.stepped(-gain @ forecast.velocity, 0.5 * (covariance + covariance.T))


def _evidence(fitted: Fitted, span_s: float) -> Evidence:
    length_px = fitted.length_px
    motion_px = span_s * fitted.speed_px_per_s
    tells = (length_px >= MIN_LENGTH_PX) & (motion_px >= MIN_MOTION_PX)
    seen = tells & fitted.is_dense
    return Evidence(
        on_count=int(fitted.on_count[tells].sum()),
        beside_count=int(fitted.beside_count[tells].sum()),
        in_view_px=float(length_px[length_px >= MIN_LENGTH_PX].sum()),
        moving_px=float(length_px[tells].sum()),
        seen_px=float(length_px[seen].sum()),
        moving_px2=float((length_px * motion_px)[tells].sum()),
        seen_px2=float((length_px * motion_px)[seen].sum()),
        seen_count=int(seen.sum()),
    )
