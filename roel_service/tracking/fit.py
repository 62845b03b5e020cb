"""One window of events against the lines of the map, by iterated least squares.

The unknowns are the pose in the middle of the window and the velocity, so that every event has the
pose of its own time; the motion model's forecast is their prior.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from roel_service.arrays import Array, BoolArray, FloatArray, IntArray
from roel_service.config.stages import TrackConfig
from roel_service.scene.events import EventSlice
from roel_service.tracking import image_kernels
from roel_service.tracking.motion import MotionState
from roel_service.tracking.pieces import MapPieces

# Events of one slot share one pose.
SLOT_US = 1_000
# Lines nearer than this share of the map's extent are cut.
MIN_DEPTH_SHARE = 0.01
# In units of the scale of a round: events so near lie on a line, and those beside it.
INNER, BESIDE = 1.0, (2.0, 4.0)
# Tukey's weight ends here, in units of the scale.
REACH = 2.5
# Length of the parts of a piece of which it is asked whether they have events.
BIN_PX = 4.0
# A piece is seen when events lie on so many of its parts, and so much denser on it than beside it.
MIN_OCCUPIED = 0.5
MIN_DENSITY_RATIO = 1.6
# A piece shorter than this in the picture says nothing of what is seen; nor does one that moves
# less than this during a window, for it makes no events.
MIN_LENGTH_PX, MIN_MOTION_PX = 8.0, 1.0
# With less of the lines in view moving, by length, a window says nothing about the pose.
MIN_MOVING_SHARE = 0.2
# Fewer events than this, of a pixel in a second, are noise: the camera rests. What is left of its
# motion then is about so large, in a window.
REST_HZ, REST_PX = 3.0, 0.5
# A line without events moves less than about so much across itself in a window. One that is foretold
# to move more than `REACH` times this is taken for hidden.
SILENT_PX = 1.0
# Steps of a round between two associations.
STEPS_PER_ROUND = 2


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
        """The window with `most` of its events, or a few more."""
        chosen = slice(0, None, max(1, len(self.slot) // most))
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


class _Motion(NamedTuple):
    """Pose and velocity as loops over events take them: rotation, centre and (6,) velocity."""

    rotation: FloatArray
    centre: FloatArray
    velocity: FloatArray

    @staticmethod
    def of(state: MotionState) -> _Motion:
        pose = state.T_world_camera
        return _Motion(pose.rotation, pose.translation, state.velocity)

    def stepped(self, step: FloatArray) -> _Motion:
        """With pose and velocity changed by (12,)."""
        rotation, centre = image_kernels.retracted(self.rotation, self.centre, step[None, :6])
        return _Motion(rotation[0], centre[0], self.velocity + step[6:])

    def poses(self, after_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(N, 3, 3) rotations and (N, 3) centres so many seconds later, were the motion even."""
        steps = after_s[:, None] * self.velocity
        return image_kernels.retracted(self.rotation, self.centre, steps)


class _Association:
    """Events beside the lines that are near them in the picture of one pose."""

    def __init__(
        self,
        motion: _Motion,
        window: Window,
        pieces: MapPieces,
        view: View,
        config: TrackConfig,
        scale_px: float,
    ) -> None:
        self.images, depths_m = image_kernels.project(
            pieces.segments,
            motion.rotation,
            motion.centre,
            view.K,
            view.width,
            view.height,
            MIN_DEPTH_SHARE * pieces.extent_m,
        )
        reach_px = BESIDE[1] * scale_px
        nearest = image_kernels.draw_nearest(self.images, reach_px, view.width, view.height)
        turned = motion.rotation.T @ motion.poses(window.slot_s)[0]
        homographies = view.K @ turned @ np.linalg.inv(view.K)
        piece = image_kernels.pieces_near(window.xy_px, window.slot, homographies, nearest)
        near = np.flatnonzero(piece != image_kernels.NO_PIECE)
        self.piece = piece[near]
        self.xy_px, self.slot = window.xy_px[near], window.slot[near]
        self.slot_s = window.slot_s
        self.after_s = window.slot_s[self.slot]
        self.edge = pieces.edge[self.piece]
        across = self.images[:, 2:] - self.images[:, :2]
        # (P,) what is seen of each piece.
        self.length_px = np.hypot(across[:, 0], across[:, 1])
        self._line_px2 = _line_variance_px2(depths_m, view, config)
        self._event_px2 = (config.event_noise_px * scale_px) ** 2
        self._scale_px = scale_px
        self._pieces, self._K = pieces, view.K

    def speeds_px_per_s(self, motion: _Motion) -> FloatArray:
        """(P,) speed of the image of each piece across itself, in its middle."""
        return np.asarray(np.abs(self.by_pose(motion) @ motion.velocity))

    def by_pose(self, motion: _Motion) -> FloatArray:
        """(P, 6) how the image of each piece goes across itself when the pose steps, px."""
        count = len(self.images)
        _, by_pose = image_kernels.distances(
            0.5 * (self.images[:, :2] + self.images[:, 2:]),
            np.zeros(count, np.int64),
            np.arange(count, dtype=np.int32),
            motion.rotation[None],
            motion.centre[None],
            self._K,
            self._pieces.segments,
            self._pieces.direction,
        )
        return np.asarray(by_pose, np.float64)

    def support(self, residual_px: FloatArray) -> tuple[IntArray, IntArray, FloatArray]:
        """For each piece (P,) events on it, beside it, and the share of its parts with events."""
        return image_kernels.support(
            self.xy_px,
            self.piece,
            residual_px,
            self.images,
            INNER * self._scale_px,
            (BESIDE[0] * self._scale_px, BESIDE[1] * self._scale_px),
            BIN_PX,
        )

    def distances(self, motion: _Motion) -> tuple[FloatArray, FloatArray]:
        """(K,) distances (px) and (K, 6) derivatives by a step of the pose at the event's time."""
        return image_kernels.distances(
            self.xy_px,
            self.slot,
            self.piece,
            *motion.poses(self.slot_s),
            self._K,
            self._pieces.segments,
            self._pieces.direction,
        )

    def weights(self, residual_px: FloatArray, seen: BoolArray) -> FloatArray:
        """(K,) weights of the events, 1/px^2: those of lines that are seen, near enough.

        A line's own error is shared by all of its events: together they weigh no more than it
        allows.
        """
        return image_kernels.event_weights(
            residual_px,
            self.piece,
            seen & (self.length_px >= MIN_LENGTH_PX),
            self._line_px2,
            self._event_px2,
            REACH * self._scale_px,
        )


def _line_variance_px2(depths_m: FloatArray, view: View, config: TrackConfig) -> FloatArray:
    """(P,) variance of a line as a whole: in the picture, and in the map at its depth."""
    depths_m = np.where(depths_m > 0.0, depths_m, np.inf)
    return np.asarray(
        config.line_noise_px**2 + np.square(config.line_noise_m * view.K[0, 0] / depths_m)
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
    prior_information = np.linalg.inv(forecast.covariance)
    begin = motion = _Motion.of(forecast)
    step = np.zeros(12)
    for scale_px in scales_px:
        association = _Association(motion, window, pieces, view, config, scale_px)
        for _ in range(STEPS_PER_ROUND):
            residual_px, by_pose = association.distances(motion)
            seen = _seen(*association.support(residual_px))
            weight = association.weights(residual_px, seen)
            information, slope = image_kernels.normal_equations(
                residual_px, by_pose, association.after_s, weight
            )
            if known is not None:
                _add_silence(information, slope, association, known & ~seen, motion, window.span_s)
            covariance = np.linalg.inv(information + prior_information)
            step = step - covariance @ (slope + prior_information @ step)
            motion = begin.stepped(step)
    return WindowFit(
        state=forecast.stepped(step, covariance),
        surprise=float(np.sqrt(step @ prior_information @ step)),
        evidence=_evidence(association, motion, window.span_s),
        seen=seen,
        information=information,
        information_of_edges=_by_edge(association, by_pose, weight),
    )


def _by_edge(association: _Association, by_pose: FloatArray, weight: FloatArray) -> FloatArray:
    """(E, 12, 12) information of each edge that has events."""
    has_events = np.bincount(association.edge) > 0
    place = np.cumsum(has_events) - 1
    return np.asarray(
        image_kernels.information_by_edge(
            by_pose,
            association.after_s,
            weight,
            place[association.edge],
            int(np.count_nonzero(has_events)),
        )
    )


def _add_silence(
    information: FloatArray,
    slope: FloatArray,
    association: _Association,
    silent: BoolArray,
    motion: _Motion,
    span_s: float,
) -> None:
    """Add what lines without events say, which is that they do not move across themselves.

    Where all lines of a direction rest in the picture, nothing else holds the motion across them.
    """
    silent = silent & (association.length_px >= MIN_LENGTH_PX)
    by_velocity = span_s * association.by_pose(motion)[silent]
    motion_px = by_velocity @ motion.velocity
    near = np.maximum(0.0, 1.0 - np.square(motion_px / (REACH * SILENT_PX)))
    # They rest for one reason, and together say no more than one of them does.
    weight = np.square(near) / (SILENT_PX**2 * max(1, len(near)))
    information[6:, 6:] += (weight[:, None] * by_velocity).T @ by_velocity
    slope[6:] += by_velocity.T @ (weight * motion_px)


def _seen(on: IntArray, beside: IntArray, occupied: FloatArray) -> BoolArray:
    """(P,) whether events lie along each piece, and denser than beside it."""
    density = on / (2.0 * INNER)
    density_beside = beside / (2.0 * (BESIDE[1] - BESIDE[0]))
    return np.asarray((occupied >= MIN_OCCUPIED) & (density > MIN_DENSITY_RATIO * density_beside))


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


def _evidence(association: _Association, motion: _Motion, interval_s: float) -> Evidence:
    residual_px, _ = association.distances(motion)
    on, beside, occupied = association.support(residual_px)
    length_px = association.length_px
    motion_px = interval_s * association.speeds_px_per_s(motion)
    tells = (length_px >= MIN_LENGTH_PX) & (motion_px >= MIN_MOTION_PX)
    seen = tells & _seen(on, beside, occupied)
    return Evidence(
        on_count=int(on[tells].sum()),
        beside_count=int(beside[tells].sum()),
        in_view_px=float(length_px[length_px >= MIN_LENGTH_PX].sum()),
        moving_px=float(length_px[tells].sum()),
        seen_px=float(length_px[seen].sum()),
        moving_px2=float((length_px * motion_px)[tells].sum()),
        seen_px2=float((length_px * motion_px)[seen].sum()),
        seen_count=int(seen.sum()),
    )
