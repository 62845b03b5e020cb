"""Observations as quadratic forms of the line's Pluecker coordinates.

An event with unit ray u, seen from camera centre o, is met by the line (v, m) when
a . (v, m) = 0 with a = (o x u, u); the distance is f a.(v, m) / |m - o x v| in pixels. For squared
costs the events of an observation therefore enter through the sum of a a^T alone: 36 numbers, which
change with neither the line nor the pose of the frame, in place of hundreds of events.
"""

from __future__ import annotations

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.geometry import projection
from roel_service.mapping import moments_kernels
from roel_service.mapping.frames import Frames
from roel_service.scene.lines import LineObservations
from roel_service.scene.trajectory import Trajectory

# Positions and weights of the rays that stand for a segment: a third each at its middle and near
# its ends, which count a little more than in a uniform distribution along it.
SEGMENT_POSITIONS = np.array([0.11, 0.5, 0.89])
SEGMENT_WEIGHTS = np.full(3, 1.0 / 3.0)


def event_forms(
    observations: LineObservations,
    frames: Frames,
    trajectory: Trajectory | None,
    slot_us: int,
    event_count: int,
) -> FloatArray:
    """(M, 6, 6) mean of a a^T over the supporting events, in the camera frame of the observation.

    Args:
        observations: lines with their events, nearest in time first.
        frames: times and poses of the frames.
        trajectory: gives each event the pose at its own time; None gives all events of a frame
            the frame's pose, as the paper does.
        slot_us: events of one slot share one pose.
        event_count: events used of each observation; 0 uses all.
    """
    reach_us = int(np.abs(observations.event_dt_us).max(initial=0)) + 1
    if trajectory is None:
        slot_us = 2 * reach_us
    slot_count = -(-2 * reach_us // slot_us)
    R_frame_slot = np.broadcast_to(np.eye(3), (len(frames), slot_count, 3, 3))
    centre_frame = np.zeros((len(frames), slot_count, 3))
    if trajectory is not None:
        middles_us = frames.t_us[:, None] - reach_us + np.arange(slot_count) * slot_us
        middles_us = np.clip(middles_us + slot_us // 2, trajectory.t_us[0], trajectory.t_us[-1])
        T_world_slot = trajectory.interpolate(middles_us)
        T_frame_slot = frames.T_world_camera.inverse()[:, None] @ T_world_slot
        R_frame_slot, centre_frame = T_frame_slot.rotation, T_frame_slot.translation
    forms = np.zeros((len(observations), 6, 6))
    moments_kernels.accumulate(
        observations.frame,
        observations.event_offsets,
        projection.normalized_from_pixel(observations.event_xy_px.astype(np.float64), frames.K),
        observations.event_dt_us,
        R_frame_slot,
        centre_frame,
        reach_us,
        slot_us,
        event_count,
        forms,
    )
    return forms


def segment_forms(observations: LineObservations, frames: Frames) -> FloatArray:
    """(M, 6, 6) weighted sum of a a^T over three rays of each segment, in its camera frame."""
    start, end = observations.segments_px[:, 0], observations.segments_px[:, 1]
    points = start[:, None] + SEGMENT_POSITIONS[:, None] * (end - start)[:, None]
    rays = projection.ray_from_pixel(points, frames.K)
    forms = np.zeros((len(observations), 6, 6))
    weighted = SEGMENT_WEIGHTS[:, None, None] * rays[..., :, None] * rays[..., None, :]
    forms[:, 3:, 3:] = weighted.sum(axis=1)
    return forms
