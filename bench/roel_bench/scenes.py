"""What a benchmark runs on: a recording, and as much truth as there is about it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from roel_service.arrays import BoolArray, FloatArray, frozen_array
from roel_service.scene.camera import Camera
from roel_service.scene.clouds import PointCloud, TriangleMesh
from roel_service.scene.events import EventSource, EventStream
from roel_service.scene.trajectory import Trajectory


@dataclass(frozen=True, eq=False, kw_only=True)
class MapTruth:
    """True surfaces, and the points of them that an event camera can see.

    Attributes:
        mesh: surfaces.
        edges: observable edge points; None where only the surfaces are known.
        curved_edges: those of them that lie on round edges; None where that is not known.
    """

    mesh: TriangleMesh
    edges: PointCloud | None
    curved_edges: PointCloud | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class LineTruth:
    """True line segments, not all of which need to have been seen.

    Attributes:
        segments: (L, 2, 3) m, world frame.
    """

    segments: FloatArray

    def __post_init__(self) -> None:
        segments = frozen_array(self.segments, np.float64, (None, 2, 3), "segments")
        object.__setattr__(self, "segments", segments)


def part_of(events: EventStream, kept: BoolArray) -> EventStream:
    """The events of a (K,) mask."""
    return dataclasses.replace(
        events,
        t_us=events.t_us[kept],
        x=events.x[kept],
        y=events.y[kept],
        polarity=events.polarity[kept],
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class HeldBackEvents:
    """Events that the map is not built from and ought to explain.

    Attributes:
        events: on the clock of the scene's poses.
    """

    events: EventStream


Truth = MapTruth | LineTruth | HeldBackEvents


@dataclass(frozen=True, eq=False, kw_only=True)
class Scene:
    """One recording of the benchmark.

    Attributes:
        name: as the benchmark's tables call it.
        events: may be read more than once.
        camera: calibration.
        trajectory: true poses, or the publisher's; None for a recording without poses, of which
            only the front end can run.
        noisy_trajectory: poses as a visual odometry would give them; None where there are none.
        truth: None where nothing is known.
        is_tuning: whether parameters were chosen by looking at it; such scenes count in no mean.
    """

    name: str
    events: EventSource
    camera: Camera
    trajectory: Trajectory | None
    noisy_trajectory: Trajectory | None = None
    truth: Truth | None = None
    is_tuning: bool = False

    @property
    def sensor(self) -> str:
        """Width and height, written WxH."""
        return f"{self.camera.width}x{self.camera.height}"
