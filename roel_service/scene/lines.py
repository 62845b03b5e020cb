"""Lines from the first detection to the finished map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roel_service.arrays import Array, FloatArray, IntArray, frozen_array
from roel_service.geometry.se3 import SE3

# Largest |direction . moment| / |moment| of a Pluecker line: float64 rounding of a cross product.
ORTHOGONALITY_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False, kw_only=True)
class LineObservations:
    """2D lines of all frames with their supporting events, in ideal (undistorted) pixels.

    M observations, P supporting events, stored ragged: those of observation m are the half-open
    range event_offsets[m]:event_offsets[m + 1].

    Attributes:
        frame: (M,) int32, index of the frame, non-decreasing.
        segments_px: (M, 2, 2) [line, endpoint, xy].
        polarity: (M,) int8, -1 or +1; 0 where the two polarities were not told apart.
        normal_speed_px_per_ms: (M,) speed along the left-hand normal (-dy, dx) of the segment.
        event_offsets: (M + 1,) int64.
        event_xy_px: (P, 2) float32, at each event's own time (no motion compensation).
        event_dt_us: (P,) int32, time of each event minus the time of its frame.
    """

    frame: Array
    segments_px: FloatArray
    polarity: Array
    normal_speed_px_per_ms: FloatArray
    event_offsets: IntArray
    event_xy_px: Array
    event_dt_us: Array

    def __post_init__(self) -> None:
        count = len(self.frame)
        events = len(self.event_dt_us)
        for name, dtype, shape in (
            ("frame", np.int32, (count,)),
            ("segments_px", np.float64, (count, 2, 2)),
            ("polarity", np.int8, (count,)),
            ("normal_speed_px_per_ms", np.float64, (count,)),
            ("event_offsets", np.int64, (count + 1,)),
            ("event_xy_px", np.float32, (events, 2)),
            ("event_dt_us", np.int32, (events,)),
        ):
            object.__setattr__(self, name, frozen_array(getattr(self, name), dtype, shape, name))
        _require_partition(self.event_offsets, events, "event_offsets")

    def __len__(self) -> int:
        return len(self.frame)


@dataclass(frozen=True, eq=False, kw_only=True)
class LineTracks:
    """Observations of the same 3D line; those of track j are observation[offsets[j]:offsets[j+1]].

    While lines are still being re-associated an observation may support several of them; in a
    finished map it supports at most one (see `is_exclusive`).

    Attributes:
        offsets: (L + 1,) int64.
        observation: (S,) int32 indices into `LineObservations`.
    """

    offsets: IntArray
    observation: Array

    def __post_init__(self) -> None:
        offsets = frozen_array(self.offsets, np.int64, (None,), "offsets")
        observation = frozen_array(self.observation, np.int32, (None,), "observation")
        _require_partition(offsets, len(observation), "offsets")
        object.__setattr__(self, "offsets", offsets)
        object.__setattr__(self, "observation", observation)

    def __len__(self) -> int:
        return len(self.offsets) - 1

    def __getitem__(self, index: int) -> Array:
        """(n,) observations of one track."""
        return self.observation[self.offsets[index] : self.offsets[index + 1]]

    @property
    def sizes(self) -> IntArray:
        """(L,) observations of each track."""
        return np.diff(self.offsets)

    @property
    def track_of_row(self) -> IntArray:
        """(S,) the track of each row of `observation`."""
        return np.repeat(np.arange(len(self)), self.sizes)

    def is_exclusive(self) -> bool:
        """Whether each observation is in at most one track."""
        return len(np.unique(self.observation)) == len(self.observation)

    def take(self, tracks: Array) -> LineTracks:
        """The tracks of these indices, or of this mask, in that order."""
        return LineTracks.from_lists([self[track] for track in np.arange(len(self))[tracks]])

    @staticmethod
    def from_rows(track: IntArray, observation: Array, count: int) -> LineTracks:
        """`count` tracks from (S,) pairs of track and observation, in the order of the rows."""
        order = np.argsort(track, kind="stable")
        sizes = np.bincount(track, minlength=count)
        offsets = np.concatenate([[0], np.cumsum(sizes)])
        return LineTracks(offsets=offsets, observation=observation[order])

    @staticmethod
    def from_lists(lists: list[Array]) -> LineTracks:
        """Tracks from one array of observations each."""
        sizes = [len(members) for members in lists]
        joined = np.concatenate(lists) if lists else np.empty(0, np.int32)
        return LineTracks(offsets=np.cumsum([0, *sizes]), observation=joined)


@dataclass(frozen=True, eq=False, kw_only=True)
class InfiniteLines:
    """Infinite 3D lines in Pluecker coordinates; undirected.

    Attributes:
        direction: (L, 3) unit vectors.
        moment: (L, 3) m, point x direction, normal to the direction.
    """

    direction: FloatArray
    moment: FloatArray

    def __post_init__(self) -> None:
        direction = frozen_array(self.direction, np.float64, (None, 3), "direction")
        moment = frozen_array(self.moment, np.float64, (len(direction), 3), "moment")
        object.__setattr__(self, "direction", direction)
        object.__setattr__(self, "moment", moment)
        if len(direction) == 0:
            return
        if np.abs(np.linalg.norm(direction, axis=1) - 1.0).max() > ORTHOGONALITY_TOLERANCE:
            raise ValueError("direction: expected unit vectors")
        along = np.abs(np.sum(direction * moment, axis=1))
        if (along > ORTHOGONALITY_TOLERANCE * (1.0 + np.linalg.norm(moment, axis=1))).any():
            raise ValueError("moment: expected vectors normal to the direction")

    def __len__(self) -> int:
        return len(self.direction)

    def take(self, lines: Array | slice) -> InfiniteLines:
        """The lines of these indices, or of this mask, in that order."""
        return InfiniteLines(direction=self.direction[lines], moment=self.moment[lines])


@dataclass(frozen=True, eq=False, kw_only=True)
class LineMap:
    """The product: 3D line segments in the world frame; undirected.

    Attributes:
        segments: (L, 2, 3) float64 [segment, endpoint, coordinate], m.
        observation_count: (L,) int32, frames that saw the line; 0 where unknown.
        rms_residual_px: (L,) float32, NaN-free; 0 where unknown.
        sigma_m: (L,) float32, standard deviation of the worse end; 0 where unknown.
    """

    segments: FloatArray
    observation_count: Array
    rms_residual_px: Array
    sigma_m: Array

    def __post_init__(self) -> None:
        segments = frozen_array(self.segments, np.float64, (None, 2, 3), "segments")
        object.__setattr__(self, "segments", segments)
        for name, dtype in (
            ("observation_count", np.int32),
            ("rms_residual_px", np.float32),
            ("sigma_m", np.float32),
        ):
            column = frozen_array(getattr(self, name), dtype, (len(segments),), name)
            object.__setattr__(self, name, column)

    def __len__(self) -> int:
        return len(self.segments)

    @staticmethod
    def from_segments(segments: FloatArray) -> LineMap:
        """A map of which only the geometry is known."""
        count = len(segments)
        return LineMap(
            segments=segments,
            observation_count=np.zeros(count, np.int32),
            rms_residual_px=np.zeros(count, np.float32),
            sigma_m=np.zeros(count, np.float32),
        )

    @property
    def lengths_m(self) -> FloatArray:
        """(L,) segment lengths."""
        return np.asarray(np.linalg.norm(self.segments[:, 1] - self.segments[:, 0], axis=1))

    @property
    def bounds_m(self) -> FloatArray:
        """(2, 3) lower and upper corner of the box around all ends; not of an empty map."""
        ends = self.segments.reshape(-1, 3)
        return np.stack([ends.min(axis=0), ends.max(axis=0)])

    def transformed(self, T_b_a: SE3) -> LineMap:
        """The same map in frame b, given in frame a."""
        return LineMap(
            segments=T_b_a @ self.segments,
            observation_count=self.observation_count,
            rms_residual_px=self.rms_residual_px,
            sigma_m=self.sigma_m,
        )


def _require_partition(offsets: IntArray, count: int, name: str) -> None:
    """Raise ValueError unless offsets rise from 0 to count and so cut `count` rows into ranges."""
    sound = len(offsets) > 0 and offsets[0] == 0 and offsets[-1] == count
    if not (sound and (np.diff(offsets) >= 0).all()):
        raise ValueError(f"{name}: expected a non-decreasing partition of {count} rows")
