"""Long recordings are refined in windows that overlap, so that memory stays bounded.

What an odometry has drifted it forgets; a window needs to know nothing of poses far before it. In
an overlap both windows have found the poses, and one fades into the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from roel_service.arrays import FloatArray, IntArray
from roel_service.config.stages import RefineConfig
from roel_service.geometry import se3
from roel_service.geometry.se3 import SE3
from roel_service.mapping.evidence import Evidence
from roel_service.mapping.front_end import Detected
from roel_service.mapping.pose_correction import MAX_CONTROL_COUNT, ORDER
from roel_service.mapping.views import views_of
from roel_service.scene.lines import LineObservations
from roel_service.scene.trajectory import Trajectory

# Windows of recordings that are too long for one have so many intervals between control points.
WINDOW_INTERVAL_COUNT = 512
# They overlap until the drift is forgotten but for 2 %, and by a quarter at the most.
OVERLAP_DRIFT_COUNT = 4.0
MAX_OVERLAP_SHARE = 0.25
# Fewer poses are no trajectory.
MIN_POSE_COUNT = 2


def pose_windows(trajectory: Trajectory, config: RefineConfig) -> list[slice]:
    """The poses of each window; one for all where they can be refined at once."""
    first_us, last_us = int(trajectory.t_us[0]), int(trajectory.t_us[-1])
    whole_us = last_us - first_us
    if whole_us <= (MAX_CONTROL_COUNT - ORDER + 1) * config.pose_interval_us:
        return [slice(0, len(trajectory))]
    most_us = WINDOW_INTERVAL_COUNT * config.pose_interval_us
    overlap_us = min(1e6 * OVERLAP_DRIFT_COUNT * config.pose_drift_s, MAX_OVERLAP_SHARE * most_us)
    count = int(np.ceil((whole_us - overlap_us) / (most_us - overlap_us)))
    step_us = (whole_us - overlap_us) / count
    begins_us = first_us + step_us * np.arange(count)
    starts = np.searchsorted(trajectory.t_us, begins_us)
    stops = np.searchsorted(trajectory.t_us, begins_us + step_us + overlap_us, side="right")
    # The last window ends with the poses, whatever rounding says.
    stops[-1] = len(trajectory)
    windows: list[slice] = []
    for start, stop in zip(starts.tolist(), stops.tolist(), strict=True):
        # A gap of the poses may leave a window without any: it joins the one before.
        if windows and min(stop - start, windows[-1].stop - windows[-1].start) < MIN_POSE_COUNT:
            windows[-1] = slice(windows[-1].start, stop)
        else:
            windows.append(slice(start, stop))
    return windows


def seen_between(detected: Detected, first_us: int, last_us: int) -> Detected:
    """The frames of a time, and what was seen in them; images and pieces of curves are left out."""
    frames, observations, evidence = detected.frames, detected.observations, detected.evidence
    first, stop = np.searchsorted(frames.t_us, [first_us, last_us + 1])
    rows = slice(*np.searchsorted(observations.frame, [first, stop]))
    frames = replace(
        frames,
        t_us=frames.t_us[first:stop],
        T_world_camera=frames.T_world_camera[first:stop],
    )
    observations = LineObservations(
        frame=observations.frame[rows] - first,
        segments_px=observations.segments_px[rows],
        polarity=observations.polarity[rows],
        normal_speed_px_per_ms=observations.normal_speed_px_per_ms[rows],
        event_offsets=np.zeros(rows.stop - rows.start + 1, np.int64),
        event_xy_px=np.empty((0, 2), np.float32),
        event_dt_us=np.empty(0, np.int32),
    )
    return Detected(
        frames=frames,
        observations=observations,
        evidence=Evidence(
            views=views_of(observations, frames),
            event_forms=evidence.event_forms[rows],
            segment_forms=evidence.segment_forms[rows],
            event_counts=evidence.event_counts[rows],
        ),
        pieces=detected.pieces,
        images={},
    )


def laid_over(
    t_us: IntArray,
    windows: Sequence[slice],
    poses: Sequence[SE3],
    covariances: Sequence[FloatArray],
) -> tuple[SE3, FloatArray]:
    """(N) poses of all windows, and their (N, 6, 6) covariances; overlaps fade.

    Args:
        t_us: (N,) times of all poses.
        windows: in order; each begins within the one before, or right after it.
        poses, covariances: of each window.
    """
    rotation, translation = np.empty((len(t_us), 3, 3)), np.empty((len(t_us), 3))
    covariance = np.empty((len(t_us), 6, 6))
    known = 0
    for window, own, own_covariance in zip(windows, poses, covariances, strict=True):
        both = slice(window.start, known)
        share = _rising(t_us[both])
        count = known - window.start
        before = SE3(rotation=rotation[both], translation=translation[both])
        faded = se3.interpolate(before, own[:count], share)
        weight = share[:, None, None]
        mixed = (1.0 - weight) * covariance[both] + weight * own_covariance[:count]
        rotation[window], translation[window] = own.rotation, own.translation
        covariance[window] = own_covariance
        rotation[both], translation[both] = faded.rotation, faded.translation
        covariance[both] = mixed
        known = window.stop
    return SE3(rotation=rotation, translation=translation), covariance


def _rising(t_us: IntArray) -> FloatArray:
    """(n,) from 0 at the first time to 1 at the last."""
    if len(t_us) < 2:
        return np.full(len(t_us), 0.5)
    return np.asarray((t_us - t_us[0]) / (t_us[-1] - t_us[0]), dtype=np.float64)
