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
from roel_service.tracking.fit import View, Window, WindowFit, fit_window, window_of
from roel_service.tracking.locate import EVENT_SCALES_PX, Eyes, locate
from roel_service.tracking.motion import MotionState
from roel_service.tracking.pieces import pieces_of
from roel_service.tracking.verdict import Verdict, is_possible

# To be found, a pose needs events this far around it; to be followed, those of its interval do.
FINDING_HALF_US = 25_000
# A lost pose is looked for in so many intervals at once, and in every so many after that.
FINDING_AT_ONCE, FINDING_STRIDE = 4, 7
# A camera that is out of sight goes on for so long, at the most.
MAX_COAST_S = 1.0
# Each time it is looked for around another place; these wander off as a hand-held camera does.
WANDER_M_S, WANDER_DEG_S = 0.2, 15.0
MAX_WANDER_S = 3.0
# Without events for so long, the camera may be anywhere within reach.
MAX_SILENCE_US = 500_000


class PoseTracker:
    """Follows a camera: events in, one pose for each interval out.

    Memory holds the map, one interval of events and the last chunk that came.

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
        self._state: MotionState | None = None
        self._verdict = Verdict()
        self.guess(guess)

    def guess(self, T_world_camera: SE3) -> None:
        """Give up what is known, and look around another pose."""
        self._last = MotionState(
            t_us=self._next_us,
            T_world_camera=T_world_camera,
            velocity=np.zeros(6),
            covariance=np.zeros((12, 12)),
        )
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
        return max(half_us, FINDING_HALF_US) if self._state is None else half_us

    def _pose(self, buffer: EventStream) -> TrackedPose:
        """The next interval's pose."""
        first_us = self._next_us - self._config.interval_us // 2
        span_us = (first_us, first_us + self._config.interval_us)
        start, stop = np.searchsorted(buffer.t_us, span_us)
        events = buffer.slice(int(start), int(stop), self._next_us)
        window = window_of(events, self._eyes.ideal_px, span_us, self._config.max_event_count)
        self._next_us += self._config.interval_us
        if self._state is None:
            return self._found(window, buffer)
        return self._followed(self._state, window)

    def _followed(self, state: MotionState, window: Window) -> TrackedPose:
        eyes = self._eyes
        forecast = state.foretold(window.t_us, self._config)
        fit = fit_window(forecast, window, eyes.pieces, eyes.view, self._config, EVENT_SCALES_PX)
        status = self._verdict.of(fit, self._config)
        if status is PoseStatus.LOST:
            self._lose()
            return _lost(window, fit)
        self._state = fit.state
        if status is PoseStatus.TRACKING:
            self._last = fit.state
        return _told(window, status, fit)

    def _found(self, window: Window, buffer: EventStream) -> TrackedPose:
        self._lost_count += 1
        if self._lost_count > FINDING_AT_ONCE and self._lost_count % FINDING_STRIDE:
            return _lost(window, None)
        fit = locate(
            self._place_to_look(window.t_us), buffer, window, self._eyes, self._config, self._rng
        )
        if fit is None or not is_possible(fit, self._config):
            return _lost(window, fit)
        self._state = fit.state
        self._verdict = Verdict()
        return _told(window, PoseStatus.UNCERTAIN, fit)

    def _lose(self) -> None:
        self._state = None
        self._lost_count = 0

    def _place_to_look(self, t_us: int) -> SE3:
        """Where the last motion that could be relied on leads or began, and ever farther around it."""
        went_on = self._lost_count % 2 == 1
        after_s = (t_us - self._last.t_us) * 1e-6 if went_on else 0.0
        place = self._last.poses(np.array(np.clip(after_s, 0.0, MAX_COAST_S)))
        lost_s = (self._lost_count - 1) * self._config.interval_us * 1e-6
        deviation = np.array([np.deg2rad(WANDER_DEG_S)] * 3 + [WANDER_M_S] * 3)
        wandered = self._rng.normal(size=6) * deviation * min(lost_s, MAX_WANDER_S)
        return place.retract(wandered)


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
