"""Poses of a tracked camera, as messages."""

from __future__ import annotations

import dataclasses

from roel_service.config.stages import TrackConfig
from roel_service.geometry.se3 import SE3
from roel_service.scene.camera import Camera
from roel_service.scene.results import PoseStatus, TrackedPose
from roel_service.v1 import localization_pb2, types_pb2
from roel_service.wire.configs import tables_to_proto
from roel_service.wire.nouns import (
    camera_to_proto,
    matrix6_from_proto,
    matrix6_to_proto,
    transform_from_proto,
    transform_to_proto,
)

_FRAMES = ("world", "camera")

_STATUSES = {
    PoseStatus.TRACKING: localization_pb2.TrackPosesResponse.STATUS_TRACKING,
    PoseStatus.UNCERTAIN: localization_pb2.TrackPosesResponse.STATUS_UNCERTAIN,
    PoseStatus.LOST: localization_pb2.TrackPosesResponse.STATUS_LOST,
}
_STATUS_OF = {value: status for status, value in _STATUSES.items()}


def tracking_setup(
    map_version: str, camera: Camera, T_world_camera: SE3, t_us: int, config: TrackConfig | None
) -> localization_pb2.TrackingSetup:
    """Where a camera begins to be tracked; arguments as of `AsyncClient.tracking`."""
    setup = localization_pb2.TrackingSetup(
        map_version=map_version,
        camera=camera_to_proto(camera),
        T_world_camera=guess_to_proto(T_world_camera),
        t_us=t_us,
    )
    if config is not None:
        setup.config.CopyFrom(tables_to_proto({"track": dataclasses.asdict(config)}).track)
    return setup


def guess_to_proto(T_world_camera: SE3) -> types_pb2.Transform:
    """About where the camera is."""
    return transform_to_proto(T_world_camera, *_FRAMES)


def tracked_pose_to_proto(
    pose: TrackedPose, map_version: str, seq: int
) -> localization_pb2.TrackPosesResponse:
    """A pose, the map that it is in, and the last chunk that it rests on."""
    message = localization_pb2.TrackPosesResponse(
        map_version=map_version,
        t_us=pose.t_us,
        status=_STATUSES[pose.status],
        seq=seq,
        seen_share=pose.seen_share,
        sharpness=pose.sharpness,
        event_count=pose.event_count,
    )
    if pose.T_world_camera is not None and pose.covariance is not None:
        message.T_world_camera.CopyFrom(guess_to_proto(pose.T_world_camera))
        message.covariance.CopyFrom(matrix6_to_proto(pose.covariance))
    return message


def tracked_pose_from_proto(message: localization_pb2.TrackPosesResponse) -> TrackedPose:
    """The pose of an answer."""
    has_pose = message.HasField("T_world_camera")
    pose = transform_from_proto(message.T_world_camera, "T_world_camera") if has_pose else None
    return TrackedPose(
        t_us=message.t_us,
        status=_STATUS_OF[message.status],
        T_world_camera=pose,
        covariance=matrix6_from_proto(message.covariance) if has_pose else None,
        seen_share=message.seen_share,
        sharpness=message.sharpness,
        event_count=message.event_count,
    )
