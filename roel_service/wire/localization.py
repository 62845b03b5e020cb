"""What a localization found, as a message."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from roel_service.config.stages import LocalizeConfig
from roel_service.geometry.se3 import SE3
from roel_service.scene.camera import Camera
from roel_service.scene.results import (
    LocalizationStatus,
    NoPoseReason,
    PanoLocResult,
    PoseHypothesis,
)
from roel_service.v1 import localization_pb2, types_pb2
from roel_service.wire.configs import tables_to_proto
from roel_service.wire.nouns import (
    camera_to_proto,
    matrix6_from_proto,
    matrix6_to_proto,
    transform_from_proto,
    transform_to_proto,
)

_FRAMES = ("world", "panorama")

_STATUSES = {
    LocalizationStatus.FOUND: localization_pb2.LocalizeResponse.STATUS_FOUND,
    LocalizationStatus.AMBIGUOUS: localization_pb2.LocalizeResponse.STATUS_AMBIGUOUS,
    LocalizationStatus.NOT_FOUND: localization_pb2.LocalizeResponse.STATUS_NOT_FOUND,
}


def localize_request(
    map_versions: Sequence[str],
    *,
    T_prior: SE3 | None = None,
    camera: Camera | None = None,
    max_hypothesis_count: int = 0,
    config: LocalizeConfig | None = None,
) -> localization_pb2.LocalizeRequest:
    """What to ask, without a picture; arguments as of `AsyncClient.localize`."""
    request = localization_pb2.LocalizeRequest(
        map_versions=map_versions, max_hypothesis_count=max_hypothesis_count
    )
    if T_prior is not None:
        request.prior.CopyFrom(prior_to_proto(T_prior))
    if camera is not None:
        request.camera.CopyFrom(camera_to_proto(camera))
    if config is not None:
        tables = {"localize": dataclasses.asdict(config)}
        request.config.CopyFrom(tables_to_proto(tables).localize)
    return request


def prior_to_proto(T_world_panorama: SE3) -> types_pb2.Transform:
    """A first pose."""
    return transform_to_proto(T_world_panorama, *_FRAMES)


def localization_to_proto(
    result: PanoLocResult, map_versions: Sequence[str], max_hypothesis_count: int
) -> localization_pb2.LocalizeResponse:
    """All of the result, and its best hypotheses.

    Args:
        map_versions: names of the maps that were searched.
        max_hypothesis_count: of those that are told.
    """
    return localization_pb2.LocalizeResponse(
        status=_STATUSES[result.status],
        reason="" if result.reason is None else result.reason.value,
        score=result.score,
        hypotheses=[
            _hypothesis_to_proto(item, map_versions)
            for item in result.hypotheses[:max_hypothesis_count]
        ],
        diagnostics=localization_pb2.LocalizationDiagnostics(
            arc_count=result.arc_count,
            rotation_count=result.rotation_count,
            candidate_count=result.candidate_count,
            runner_up_ratio=1.0 - result.margin,
        ),
        map_versions=map_versions,
    )


def localization_from_proto(message: localization_pb2.LocalizeResponse) -> PanoLocResult:
    """The result that a server found."""
    statuses = {number: status for status, number in _STATUSES.items()}
    map_versions = list(message.map_versions)
    return PanoLocResult(
        status=statuses[message.status],
        reason=NoPoseReason(message.reason) if message.reason else None,
        hypotheses=tuple(_hypothesis_from_proto(item, map_versions) for item in message.hypotheses),
        score=message.score,
        margin=1.0 - message.diagnostics.runner_up_ratio,
        arc_count=message.diagnostics.arc_count,
        rotation_count=message.diagnostics.rotation_count,
        candidate_count=message.diagnostics.candidate_count,
    )


def _hypothesis_to_proto(
    hypothesis: PoseHypothesis, map_versions: Sequence[str]
) -> localization_pb2.PoseHypothesis:
    return localization_pb2.PoseHypothesis(
        map_version=map_versions[hypothesis.map_index],
        T_world_panorama=transform_to_proto(hypothesis.T_world_panorama, *_FRAMES),
        score=hypothesis.score,
        covariance=matrix6_to_proto(hypothesis.covariance),
        explained_2d=hypothesis.explained_2d,
        explained_3d=hypothesis.explained_3d,
    )


def _hypothesis_from_proto(
    message: localization_pb2.PoseHypothesis, map_versions: Sequence[str]
) -> PoseHypothesis:
    return PoseHypothesis(
        T_world_panorama=transform_from_proto(message.T_world_panorama, "T_world_panorama"),
        score=message.score,
        covariance=matrix6_from_proto(message.covariance),
        explained_2d=message.explained_2d,
        explained_3d=message.explained_3d,
        map_index=map_versions.index(message.map_version),
    )
