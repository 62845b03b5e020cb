"""Poses of an event camera in a map of lines, while it moves."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from itertools import pairwise

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.config.stages import TrackConfig
from roel_service.errors import EventsError
from roel_service.geometry.projection import undistortion_table
from roel_service.geometry.se3 import SE3
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventStream, concatenate, time_not_monotone
from roel_service.scene.lines import LineMap
from roel_service.scene.results import PoseStatus, TrackedPose
from roel_service.tracking.fit import View, Window, WindowFit, window_of
from roel_service.tracking.follower import Follower
from roel_service.tracking.pieces import pieces_of
from roel_service.tracking.pursuit import Pursuit
from roel_service.tracking.search import Search
from roel_service.tracking.sight import Eyes, glimpse
from roel_service.tracking.whereabouts import Whereabouts

# To be found, a pose needs events this far around it; to be followed, those of its interval do.
FINDING_HALF_US = 25_000
# A lost pose is looked for in so many intervals at once, then, for a while, in every so many, and in
# every so many after that, as is one that does not convince.
FINDING_AT_ONCE, EARLY_COUNT, EARLY_STRIDE, FINDING_STRIDE = 2, 16, 4, 10
# So many searches wait for each other.
MAX_SEARCH_COUNT = 4
# Events are kept in so many pieces.
MAX_PIECE_COUNT = 64
# Without events for so long, the camera may be anywhere within reach.
MAX_SILENCE_US = 500_000


class PoseTracker:
    """Follows a camera: events in, one pose for each interval out.

    Memory holds the map, one interval of events, the last chunk that came and, during a search, some
    events of the intervals since it began.

    Where several answers explain what is seen about equally well, all are followed, and the best
    one is told as `UNCERTAIN`. While none convinces, others are looked for beside them. Live, a
    search takes ten intervals or so, a slice in each, on a thread of its own.

    Args:
        line_map: where the camera is.
        camera: calibration.
        config: parameters.
        guess: rough `T_world_camera` of the first events, within `config.reach_m` and `reach_deg`.
        seed: fixes the chance of the search.
        is_live: whether events come as time passes, and a pose may not wait; else a search is over in the
            interval in which it begins, and finds the camera earlier.

    Raises:
        NoAnswerError: TOO_FEW_LINES in the map.
    """

    def __init__(
        self,
        line_map: LineMap,
        camera: Camera,
        config: TrackConfig,
        guess: SE3,
        seed: int = 0,
        *,
        is_live: bool = True,
    ) -> None:
        self._config, self._is_live = config, is_live
        self._eyes = Eyes(
            camera=camera,
            ideal_px=undistortion_table(camera),
            view=View(K=camera.matrix, width=camera.width, height=camera.height),
            pieces=pieces_of(line_map),
        )
        self._rng = np.random.default_rng(seed)
        self._beside = ThreadPoolExecutor(max_workers=1, thread_name_prefix="search")
        # Events in the order of time, in pieces as they came.
        self._recent: list[EventStream] = []
        self._next_us = 0
        self._pursuit = Pursuit([], self._eyes, config)
        # The first one goes on, in a slice that has begun.
        self._searches: list[Search] = []
        self._slices: list[Future[None]] = []
        self._challenge: Future[list[Follower]] | None = None
        # Windows since the camera was lost, and since it was known well.
        self._lost_count = self._unsure_count = 0
        self._whereabouts = Whereabouts(guess, self._eyes.pieces.extent_m)

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
        self._receive(events)
        poses = []
        while events.t_us[-1] >= self._next_us + self._reach_us():
            poses.append(self._pose(self._needed()))
        return poses

    def _receive(self, events: EventStream) -> None:
        """Keep the next events."""
        camera = self._eyes.camera
        if (events.width, events.height) != (camera.width, camera.height):
            expected = f"a sensor of {camera.width}x{camera.height} as in the calibration"
            found = f"{events.width}x{events.height}"
            raise EventsError("events", expected, found, reason="SENSOR_MISMATCH")
        first_us = int(events.t_us[0])
        if not self._recent:
            self._next_us = first_us + self._reach_us()
        elif first_us < self._recent[-1].t_us[-1]:
            raise time_not_monotone(0, "events")
        elif first_us > self._next_us + MAX_SILENCE_US:
            self._lose()
            self._next_us = first_us + self._reach_us()
        self._recent.append(events)
        if len(self._recent) > MAX_PIECE_COUNT:
            self._needed()

    def _needed(self) -> EventStream:
        """The events that are still needed, in one piece."""
        keep_from_us = self._next_us - max(self._config.interval_us, FINDING_HALF_US)
        # One piece may be a whole recording.
        events = concatenate(self._recent) if len(self._recent) > 1 else self._recent[0]
        first = np.searchsorted(events.t_us, keep_from_us)
        self._recent = [events.part(min(int(first), len(events) - 1), len(events))]
        return self._recent[0]

    def _reach_us(self) -> int:
        """Time after the next pose of which events are needed."""
        half_us = self._config.interval_us - self._config.interval_us // 2
        return max(half_us, FINDING_HALF_US) if self._pursuit.is_over else half_us

    def _pose(self, buffer: EventStream) -> TrackedPose:
        """The next interval's pose."""
        first_us = self._next_us - self._config.interval_us // 2
        span_us = (first_us, first_us + self._config.interval_us)
        start, stop = np.searchsorted(buffer.t_us, span_us)
        events = buffer.slice(int(start), int(stop), self._next_us)
        window = window_of(events, self._eyes.ideal_px, span_us, self._config.max_event_count)
        around = _between(buffer, self._next_us - FINDING_HALF_US, self._next_us + self._reach_us())
        self._next_us += self._config.interval_us
        self._gather()
        for search in self._searches:
            search.see(window)
        # What is done beside is gathered with the next window: no pose waits for it.
        self._slices = [self._beside.submit(search.go_on) for search in self._searches[:1]]
        fit: WindowFit | None = None
        if self._pursuit.is_over:
            self._watched(window, around)
        else:
            fit = self._followed(window, around)
        # A search is a challenge itself.
        if not self._slices and (challenge := self._pursuit.challenge(window, self._rng)):
            self._challenge = self._beside.submit(challenge.others)
        if not self._is_live:
            self._gather(finish=True)
        return _told(window, self._pursuit, fit)

    def _gather(self, *, finish: bool = False) -> None:
        """The slice of the search that was done beside, or all of it.

        What a search has found is taken up once it is up to date; then the others are idle.
        """
        for each in self._slices:
            each.result()
        self._slices = []
        if finish:
            for search in self._searches:
                search.finish()
        for search in self._searches:
            if search.found is not None and not search.found.is_over:
                self._pursuit.join(search.found.followers)
                self._searches = []
                return
        self._searches = [search for search in self._searches if search.found is None]

    def _followed(self, window: Window, around: EventStream) -> WindowFit:
        """Go on with what is known: the best answer's fit, though it be lost by it."""
        challenge, self._challenge = self._challenge, None
        fit = self._pursuit.follow(window, tuple if challenge is None else challenge.result)
        if self._pursuit.is_over:
            self._lost_count = self._unsure_count = 0
            return fit
        best = self._pursuit.followers[0]
        is_sure = self._pursuit.status is PoseStatus.TRACKING
        if is_sure:
            self._whereabouts.relied_on(best.state)
        place = best.state.T_world_camera
        turn_rate = place.rotation.T @ best.state.velocity[:3]
        self._whereabouts.turned(turn_rate, window.span_s)
        self._unsure_count = 0 if is_sure else self._unsure_count + 1
        if self._unsure_count % FINDING_STRIDE == FINDING_STRIDE - 1 and not self._searches:
            self._search(place, turn_rate, window, around, best.before)
        return fit

    def _watched(self, window: Window, around: EventStream) -> None:
        """See how a lost camera turns, and look for it now and then."""
        self._whereabouts.lost(window.t_us)
        attempt, self._lost_count = self._lost_count, self._lost_count + 1
        turn_rate = glimpse(around, window.t_us, self._eyes).turn_rate
        if _is_searched(attempt) and len(self._searches) < MAX_SEARCH_COUNT:
            place = self._whereabouts.place(window.t_us, attempt, self._rng)
            self._search(place, turn_rate, window, around)
        self._whereabouts.turned(turn_rate, window.span_s)

    def _search(
        self,
        place: SE3,
        turn_rate: FloatArray,
        window: Window,
        around: EventStream,
        before: float = 1.0,
    ) -> None:
        """Look around a place from the next interval on."""
        rng = self._rng.spawn(1)[0]
        self._searches.append(
            Search(place, turn_rate, window, around, self._eyes, self._config, rng, before)
        )

    def _lose(self) -> None:
        self._pursuit = Pursuit([], self._eyes, self._config)
        self._searches, self._challenge = [], None
        self._lost_count = self._unsure_count = 0


def _is_searched(attempt: int) -> bool:
    """Whether a lost camera is looked for in this window, which takes as long as many others."""
    stride = EARLY_STRIDE if attempt < EARLY_COUNT else FINDING_STRIDE
    return attempt < FINDING_AT_ONCE or attempt % stride == 0


def _between(events: EventStream, first_us: int, last_us: int) -> EventStream:
    first, last = np.searchsorted(events.t_us, [first_us, last_us])
    return events.part(int(first), int(last))


def _told(window: Window, pursuit: Pursuit, last_fit: WindowFit | None) -> TrackedPose:
    fit = last_fit if pursuit.is_over else pursuit.followers[0].fit
    state = None if pursuit.is_over or fit is None else fit.state
    return TrackedPose(
        t_us=window.t_us,
        status=pursuit.status,
        T_world_camera=None if state is None else state.T_world_camera,
        covariance=None if state is None else state.covariance[:6, :6],
        seen_share=0.0 if fit is None else fit.evidence.seen_share,
        sharpness=0.0 if fit is None else fit.evidence.sharpness,
        event_count=window.event_count,
    )
