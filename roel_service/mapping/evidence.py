"""What the observations say about lines, in the form that the costs use."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roel_service.arrays import Array, FloatArray
from roel_service.config.stages import FramesConfig, RefineConfig
from roel_service.mapping.frames import Frames
from roel_service.mapping.moments import event_forms, segment_forms
from roel_service.mapping.views import Views, views_of
from roel_service.scene.lines import LineObservations
from roel_service.scene.trajectory import Trajectory


@dataclass(frozen=True, eq=False, kw_only=True)
class Evidence:
    """Everything that is measured about the observations, for the costs.

    Attributes:
        views: M viewing planes.
        event_forms: (M, 6, 6) mean of a a^T over the events, camera frame.
        segment_forms: (M, 6, 6) the same over three points of the segment.
        event_counts: (M,) events behind each form.
    """

    views: Views
    event_forms: FloatArray
    segment_forms: FloatArray
    event_counts: Array


def measure_evidence(
    observations: LineObservations,
    frames: Frames,
    trajectory: Trajectory,
    frames_config: FramesConfig,
    refine_config: RefineConfig,
) -> Evidence:
    """Viewing planes and quadratic forms of observations that carry their events."""
    forms = supporting_forms(observations, frames, trajectory, frames_config, refine_config)
    return evidence_of(observations, frames, forms, supporting_counts(observations, refine_config))


def supporting_forms(
    observations: LineObservations,
    frames: Frames,
    trajectory: Trajectory,
    frames_config: FramesConfig,
    refine_config: RefineConfig,
) -> FloatArray:
    """(M, 6, 6) forms of the supporting events; after it the events themselves are not needed.

    Where rotation is compensated each event counts with the pose at its own time, else with that
    of its frame, as in the paper.
    """
    return event_forms(
        observations,
        frames,
        trajectory if frames_config.compensate_rotation else None,
        frames_config.slot_us,
        refine_config.event_count_per_line,
    )


def supporting_counts(observations: LineObservations, refine_config: RefineConfig) -> Array:
    """(M,) events behind each of the `supporting_forms`."""
    counts = np.diff(observations.event_offsets)
    return np.minimum(counts, refine_config.event_count_per_line or len(observations.event_dt_us))


def evidence_of(
    observations: LineObservations, frames: Frames, forms: FloatArray, event_counts: Array
) -> Evidence:
    """The evidence of observations whose events were summed up before."""
    return Evidence(
        views=views_of(observations, frames),
        event_forms=forms,
        segment_forms=segment_forms(observations, frames),
        event_counts=event_counts,
    )
