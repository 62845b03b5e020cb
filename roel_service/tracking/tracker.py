"""Poses of an event camera in a map of lines, while it moves."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from roel_service.config.stages import TrackConfig
from roel_service.errors import EventsError
from roel_service.geometry.projection import undistortion_table
from roel_service.geometry.se3 import SE3
from roel_service.mapping.frames import extended
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventStream, time_not_monotone
from roel_service.scene.lines import LineMap
from roel_service.scene.results import PoseStatus, TrackedPose
from roel_service.tracking.challenge import challengers
from roel_service.tracking.fit import View, Window, WindowFit, window_of
from roel_service.tracking.follower import Follower, rivals
from roel_service.tracking.locate import locate
from roel_service.tracking.pieces import pieces_of
from roel_service.tracking.sight import Eyes, glimpse, look
from roel_service.tracking.verdict import is_possible
from roel_service.tracking.whereabouts import Whereabouts

# To be found, a pose needs events this far around it; to be followed, those of its interval do.
FINDING_HALF_US = 25_000
# A lost pose is looked for in so many intervals at once, then, for a while, in every so many, and in
# every so many after that.
FINDING_AT_ONCE, EARLY_COUNT, EARLY_STRIDE, FINDING_STRIDE = 2, 16, 4, 10
# Its turn is looked at in every so many.
GLIMPSE_STRIDE = 2
# Without events for so long, the camera may be anywhere within reach.
MAX_SILENCE_US = 500_000


class PoseTracker:
    """Follows a camera: events in, one pose for each interval out.

    Memory holds the map, one interval of events and the last chunk that came.

    Where several answers explain what is seen about equally well, all are followed, and the best
    one is told as `UNCERTAIN`. While none convinces, others are looked for beside them.

    Args:
        line_map: where the camera is.
        camera: calibration.
        config: parameters.
        guess: rough `T_world_camera` of the first events, within `config.reach_m` and `reach_deg`.
        seed: fixes the chance of the search.

    Raises:
        NoAnswerError: TOO_FEW_LINES in the map.
    """

    def __init__(
        self, line_map: LineMap, camera: Camera, config: TrackConfig, guess: SE3, seed: int = 0
    ) -> None:
        self._config = config
        self._eyes = Eyes(
            camera=camera,
            ideal_px=undistortion_table(camera),
            view=View(K=camera.matrix, width=camera.width, height=camera.height),
            pieces=pieces_of(line_map),
        )
        self._rng = np.random.default_rng(seed)
        self._buffer: EventStream | None = None
        self._next_us = 0
        self._followers: list[Follower] = []
        # Of a camera that is out of sight, rad/s in its own axes.
        self._turn_rate = np.zeros(3)
        # Windows since the camera was lost, and since it was known well.
        self._lost_count = self._unsure_count = 0
        self.guess(guess)

    def guess(self, T_world_camera: SE3) -> None:
        """Give up what is known, and look around another pose."""
        self._whereabouts = Whereabouts(T_world_camera, self._eyes.pieces.extent_m)
        self._lose()

    def push(self, events: EventStream) -> list[TrackedPose]:
        """The poses of the intervals that these events complete.

        Args:
            events: the next ones, not before the last ones.

        Raises:
            EventsError: events that are older than the last ones, or of another sensor.
        """
        silences = np.flatnonzero(np.diff(events.t_us) > MAX_SILENCE_US) + 1
        poses = []
        for first, last in pairwise([0, *silences.tolist(), len(events)]):
            if first < last:
                poses += self._advanced(events.part(first, last))
        return poses

    def _advanced(self, events: EventStream) -> list[TrackedPose]:
        buffer = self._buffer = self._extended(events)
        poses = []
        while buffer.t_us[-1] >= self._next_us + self._reach_us():
            poses.append(self._pose(buffer))
        return poses

    def _extended(self, events: EventStream) -> EventStream:
        """The events that are still needed, and the next ones."""
        camera = self._eyes.camera
        if (events.width, events.height) != (camera.width, camera.height):
            expected = f"a sensor of {camera.width}x{camera.height} as in the calibration"
            found = f"{events.width}x{events.height}"
            raise EventsError("events", expected, found, reason="SENSOR_MISMATCH")
        first_us = int(events.t_us[0])
        if self._buffer is None:
            self._next_us = first_us + self._reach_us()
        elif first_us < self._buffer.t_us[-1]:
            raise time_not_monotone(0, "events")
        elif first_us > self._next_us + MAX_SILENCE_US:
            self._lose()
            self._next_us = first_us + self._reach_us()
        keep_from_us = self._next_us - max(self._config.interval_us, FINDING_HALF_US)
        return extended(self._buffer, events, keep_from_us=keep_from_us)

    def _reach_us(self) -> int:
        """Time after the next pose of which events are needed."""
        half_us = self._config.interval_us - self._config.interval_us // 2
        return max(half_us, FINDING_HALF_US) if not self._followers else half_us

    def _pose(self, buffer: EventStream) -> TrackedPose:
        """The next interval's pose."""
        first_us = self._next_us - self._config.interval_us // 2
        span_us = (first_us, first_us + self._config.interval_us)
        start, stop = np.searchsorted(buffer.t_us, span_us)
        events = buffer.slice(int(start), int(stop), self._next_us)
        window = window_of(events, self._eyes.ideal_px, span_us, self._config.max_event_count)
        around = _between(buffer, self._next_us - FINDING_HALF_US, self._next_us + self._reach_us())
        self._next_us += self._config.interval_us
        if self._followers:
            return self._followed(window, around)
        return self._found(window, around)

    def _followed(self, window: Window, around: EventStream) -> TrackedPose:
        for follower in self._followers:
            follower.follow(window, self._eyes, self._config)
        best = max(self._followers, key=lambda each: each.explained_count)
        alive = [each for each in self._followers if each.status is not PoseStatus.LOST]
        if not alive:
            self._lose()
            return _lost(window, best.fit)
        if not best.fit.evidence.is_still:
            alive += self._others(window, around, best, is_alone=len(alive) == 1)
        best, *others = self._followers = rivals(alive)
        status = PoseStatus.UNCERTAIN if others else best.status
        if status is PoseStatus.TRACKING:
            self._whereabouts.relied_on(best.state)
        self._unsure_count = 0 if status is PoseStatus.TRACKING else self._unsure_count + 1
        turn_rate = best.state.T_world_camera.rotation.T @ best.state.velocity[:3]
        self._whereabouts.turned(turn_rate, window.span_s)
        return _told(window, status, best.fit)

    def _others(
        self, window: Window, around: EventStream, best: Follower, *, is_alone: bool
    ) -> list[Follower]:
        """Other answers in place of the best one, as if they had been followed so far."""
        fits: list[WindowFit] = []
        if self._unsure_count % FINDING_STRIDE == FINDING_STRIDE - 1:
            place = best.state.T_world_camera
            turn_rate = place.rotation.T @ best.state.velocity[:3]
            sight = look(around, window.t_us, self._eyes, turn_rate)
            fits = locate(place, sight, window, self._eyes, self._config, self._rng)
        elif is_alone:
            fits = challengers(best.state, window, self._eyes, self._config, self._rng)
        return [best.instead(fit) for fit in fits if is_possible(fit, self._config)]

    def _found(self, window: Window, around: EventStream) -> TrackedPose:
        """Look for the camera, now and then; see how it turns, all the time."""
        self._whereabouts.lost(window.t_us)
        attempt, self._lost_count = self._lost_count, self._lost_count + 1
        if attempt % GLIMPSE_STRIDE == 0 or self._is_searched(attempt):
            self._turn_rate = glimpse(around, window.t_us, self._eyes).turn_rate
        turn_rate = self._turn_rate
        fits: list[WindowFit] = []
        if self._is_searched(attempt):
            sight = look(around, window.t_us, self._eyes, turn_rate)
            place = self._whereabouts.place(window.t_us, attempt, self._rng)
            fits = locate(place, sight, window, self._eyes, self._config, self._rng)
        self._whereabouts.turned(turn_rate, window.span_s)
        possible = [fit for fit in fits if is_possible(fit, self._config)]
        if not possible:
            return _lost(window, fits[0] if fits else None)
        self._followers = rivals([Follower(fit) for fit in possible])
        return _told(window, PoseStatus.UNCERTAIN, self._followers[0].fit)

    def _is_searched(self, attempt: int) -> bool:
        """Whether a lost camera is looked for in this window, which takes as long as many others."""
        stride = EARLY_STRIDE if attempt < EARLY_COUNT else FINDING_STRIDE
        return attempt < FINDING_AT_ONCE or attempt % stride == 0

    def _lose(self) -> None:
        self._followers = []
        self._lost_count = self._unsure_count = 0


def _between(events: EventStream, first_us: int, last_us: int) -> EventStream:
    first, last = np.searchsorted(events.t_us, [first_us, last_us])
    return events.part(int(first), int(last))


def _told(window: Window, status: PoseStatus, fit: WindowFit) -> TrackedPose:
    return TrackedPose(
        t_us=window.t_us,
        status=status,
        T_world_camera=fit.state.T_world_camera,
        covariance=fit.state.covariance[:6, :6],
        seen_share=fit.evidence.seen_share,
        sharpness=fit.evidence.sharpness,
        event_count=window.event_count,
    )


def _lost(window: Window, fit: WindowFit | None) -> TrackedPose:
    return TrackedPose(
        t_us=window.t_us,
        status=PoseStatus.LOST,
        T_world_camera=None,
        covariance=None,
        seen_share=0.0 if fit is None else fit.evidence.seen_share,
        sharpness=0.0 if fit is None else fit.evidence.sharpness,
        event_count=window.event_count,
    )
