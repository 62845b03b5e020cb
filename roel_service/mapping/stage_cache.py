"""What stages found, kept for a later job on the same recording.

A stage is known by its name and the parameters that it reads; the recording and the code are the
cache's own business. Entries are plain arrays: the pipeline knows nothing of files.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from roel_service.arrays import Array
from roel_service.mapping.evidence import evidence_of
from roel_service.mapping.frames import frames_at
from roel_service.mapping.front_end import Detected
from roel_service.mapping.plane_fit import observations_of_frames
from roel_service.mapping.refine import Refined
from roel_service.mapping.run import CountedEvents
from roel_service.scene.camera import Camera
from roel_service.scene.lines import InfiniteLines, LineObservations, LineTracks
from roel_service.scene.results import TrackStatus
from roel_service.scene.trajectory import Trajectory

Arrays = Mapping[str, Array]

_OBSERVED = ("frame", "segments_px", "polarity", "normal_speed_px_per_ms")
_SOLVED = ("rms_px", "origin", "information", "diverged")


class StageCache(Protocol):
    """Entries by stage and parameters; one that is gone is found anew."""

    def get(self, stage: str, parameters: Any) -> Arrays | None:
        """What was kept; None if there is nothing."""
        ...

    def keep(self, stage: str, parameters: Any, found: Arrays) -> None:
        """Keep what a stage found, perhaps in the place of something else."""
        ...


class NoCache:
    """Keeps nothing."""

    def get(self, stage: str, parameters: Any) -> Arrays | None:
        return None

    def keep(self, stage: str, parameters: Any, found: Arrays) -> None:
        """Let it go."""


def detected_to_arrays(detected: Detected, counted: CountedEvents) -> Arrays:
    """Lines of all frames, with what was counted on the way."""
    observations, evidence = detected.observations, detected.evidence
    images = {
        f"image_{frame}_{number}": image
        for frame, images in detected.images.items()
        for number, image in enumerate(images)
    }
    return {
        "t_us": detected.frames.t_us,
        "event_forms": evidence.event_forms,
        "event_counts": evidence.event_counts,
        "counts": counted.counts(),
        **{name: getattr(observations, name) for name in _OBSERVED},
        **images,
    }


def detected_from_arrays(
    arrays: Arrays, counted: CountedEvents, trajectory: Trajectory, camera: Camera
) -> Detected:
    """The inverse; the events count as if they had been read."""
    counted.restore(arrays["counts"])
    frames = frames_at(arrays["t_us"], trajectory, camera)
    observations = LineObservations(
        **{name: arrays[name] for name in _OBSERVED},
        event_offsets=np.zeros(len(arrays["frame"]) + 1, np.int64),
        event_xy_px=np.empty((0, 2), np.float32),
        event_dt_us=np.empty(0, np.int32),
    )
    images: dict[int, tuple[Array, ...]] = dict.fromkeys(range(len(frames)), ())
    for name, image in arrays.items():
        if name.startswith("image_"):
            index = int(name.split("_")[1])
            images[index] = (*images[index], image)
    return Detected(
        frames=frames,
        observations=observations,
        evidence=evidence_of(observations, frames, arrays["event_forms"], arrays["event_counts"]),
        pieces=observations_of_frames([]),
        images=images,
    )


def refined_to_arrays(refined: Refined, statuses: Counter[TrackStatus]) -> Arrays:
    """Lines, with what became of the tracks so far."""
    return {
        "direction": refined.lines.direction,
        "moment": refined.lines.moment,
        "offsets": refined.tracks.offsets,
        "observation": refined.tracks.observation,
        **{name: getattr(refined, name) for name in _SOLVED},
        "statuses": np.array([statuses[status] for status in TrackStatus], np.int64),
    }


def refined_from_arrays(arrays: Arrays) -> tuple[Refined, Counter[TrackStatus]]:
    """The inverse."""
    refined = Refined(
        lines=InfiniteLines(direction=arrays["direction"], moment=arrays["moment"]),
        tracks=LineTracks(offsets=arrays["offsets"], observation=arrays["observation"]),
        **{name: arrays[name] for name in _SOLVED},
    )
    counts = zip(TrackStatus, arrays["statuses"].tolist(), strict=True)
    return refined, Counter({status: count for status, count in counts if count})
