"""A camera that is followed in a child: entry point of conversations about poses."""

from __future__ import annotations

from roel_service.errors import RoelError, StateError
from roel_service.jobs.questions import NextChunk, NextGuess, Saying, Told, TrackingBegins
from roel_service.jobs.task import Tell
from roel_service.tracking.tracker import PoseTracker
from roel_service.tracking.warm import warm_up
from roel_service.wire.chunks import decode_chunk
from roel_service.wire.tracking import tracked_pose_to_proto


class TrackingDesk:
    """Follows one camera at a time; each beginning ends what was before."""

    def __init__(self) -> None:
        # Nobody waits for it here, as the first camera's poses would.
        warm_up()
        self._tracking: _Tracking | None = None

    def __call__(self, said: TrackingBegins | list[Saying], tell: Tell) -> Told:
        """The poses that became known, up to what cannot be used.

        Raises:
            NoAnswerError: TOO_FEW_LINES in the map.
            CorruptionError: a map file that is not what its digest says.
        """
        if isinstance(said, TrackingBegins):
            self._tracking = _Tracking(said)
            return Told(poses=[])
        if self._tracking is None:
            raise TypeError("a conversation begins with where the camera is")
        poses: list[bytes] = []
        try:
            for saying in said:
                poses += self._tracking.hear(saying)
        except RoelError as error:
            return Told(poses=poses, error=error)
        return Told(poses=poses)


class _Tracking:
    """One camera in one map."""

    def __init__(self, begins: TrackingBegins) -> None:
        self._tracker = PoseTracker(
            begins.map.line_map(), begins.camera, begins.config, begins.T_world_camera
        )
        self._map_version = begins.map.name
        self._first_us = begins.t_us
        self._seq: int | None = None
        self._last_us: int | None = None

    def hear(self, saying: Saying) -> list[bytes]:
        """Serialized `TrackPosesResponse` for every pose that became known.

        Raises:
            EventsError: events that cannot be used.
            StateError: SEQUENCE_GAP.
        """
        if isinstance(saying, NextGuess):
            self._tracker.guess(saying.T_world_camera)
            return []
        return self._poses(saying)

    def _poses(self, chunk: NextChunk) -> list[bytes]:
        if self._seq is not None and chunk.seq != self._seq + 1:
            expected = f"chunk {self._seq + 1}"
            raise StateError("events", expected, f"chunk {chunk.seq}", reason="SEQUENCE_GAP")
        events = decode_chunk(chunk.data, previous_t1_us=self._last_us)
        self._seq, self._last_us = chunk.seq, int(events.t_us[-1])
        first = int(events.t_us.searchsorted(self._first_us))
        return [
            tracked_pose_to_proto(pose, self._map_version, chunk.seq).SerializeToString()
            for pose in self._tracker.push(events.part(first, len(events)))
        ]
