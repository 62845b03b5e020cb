"""What a registration found, as a message."""

from __future__ import annotations

import dataclasses

import numpy as np

from roel_service.arrays import Array, FloatArray
from roel_service.config.stages import RegisterConfig
from roel_service.errors import InputError
from roel_service.geometry.se3 import SE3
from roel_service.scene.results import Alternative, RegistrationResult, StopReason, Verdict
from roel_service.v1 import registration_pb2, types_pb2
from roel_service.wire.configs import tables_to_proto
from roel_service.wire.nouns import (
    matrix6_from_proto,
    matrix6_to_proto,
    transform_from_proto,
    transform_to_proto,
    vector_to_proto,
)

# By their numbers in the protocol; what is not said is the first one.
METHODS = ("auto", "auto", "point", "plane", "line", "global")

_FRAMES = ("target", "map")

_VERDICTS = {
    Verdict.ACCEPTED: registration_pb2.RegisterResponse.VERDICT_ACCEPTED,
    Verdict.AMBIGUOUS: registration_pb2.RegisterResponse.VERDICT_AMBIGUOUS,
    Verdict.REJECTED: registration_pb2.RegisterResponse.VERDICT_REJECTED,
}


def register_request(
    map_version: str,
    target: str | types_pb2.BlobRef | Array,
    *,
    T_init: SE3 | None = None,
    method: str = "auto",
    up_source: FloatArray | None = None,
    up_target: FloatArray | None = None,
    config: RegisterConfig | None = None,
) -> registration_pb2.RegisterRequest:
    """What to ask; arguments as of `AsyncClient.register`."""
    if method not in METHODS:
        raise InputError("method", f"one of {', '.join(METHODS[1:])}", method)
    request = registration_pb2.RegisterRequest(
        map_version=map_version, method=METHODS.index(method, 1)
    )
    if isinstance(target, str):
        request.target_map_version = target
    elif isinstance(target, types_pb2.BlobRef):
        request.cloud.CopyFrom(target)
    else:
        request.points.points_m = np.ascontiguousarray(target, "<f4").tobytes()
    if T_init is not None:
        request.init.CopyFrom(transform_to_proto(T_init, *_FRAMES))
    if up_source is not None:
        request.up_source.CopyFrom(vector_to_proto(up_source))
    if up_target is not None:
        request.up_target.CopyFrom(vector_to_proto(up_target))
    if config is not None:
        tables = {"register": dataclasses.asdict(config)}
        request.config.CopyFrom(tables_to_proto(tables).register)
    return request


def registration_to_proto(result: RegistrationResult) -> registration_pb2.RegisterResponse:
    """All of the result; which version it is of, and how long it took, is the caller's to add."""
    message = registration_pb2.RegisterResponse(
        T_target_source=transform_to_proto(result.T_target_source, *_FRAMES),
        scale=result.scale,
        converged=result.converged,
        stop_reason=result.stop_reason.value,
        verdict=_VERDICTS[result.verdict],
        inside=result.inside,
        fitness=result.fitness,
        overlap=result.overlap,
        agreement=result.agreement,
        inlier_rmse_m=result.inlier_rmse_m,
        weak_directions=[
            registration_pb2.Direction6(values=direction.tolist())
            for direction in result.weak_directions
        ],
        alternatives=[
            registration_pb2.RegistrationAlternative(
                T_target_source=transform_to_proto(other.T_target_source, *_FRAMES),
                scale=other.scale,
                fitness=other.fitness,
                score=other.score,
            )
            for other in result.alternatives
        ],
        iteration_count=result.iteration_count or 0,
    )
    if result.information is not None:
        message.information.CopyFrom(matrix6_to_proto(result.information))
        message.eigenvalues.extend(np.linalg.eigvalsh(result.information).tolist())
    return message


def registration_from_proto(message: registration_pb2.RegisterResponse) -> RegistrationResult:
    """The result that a server found."""
    verdicts = {number: verdict for verdict, number in _VERDICTS.items()}
    weak = [list(direction.values) for direction in message.weak_directions]
    return RegistrationResult(
        T_target_source=transform_from_proto(message.T_target_source, "T_target_source"),
        scale=message.scale,
        stop_reason=StopReason(message.stop_reason),
        verdict=verdicts[message.verdict],
        inside=message.inside,
        fitness=message.fitness,
        overlap=message.overlap,
        agreement=message.agreement,
        inlier_rmse_m=message.inlier_rmse_m if message.HasField("inlier_rmse_m") else None,
        information=(
            matrix6_from_proto(message.information) if message.HasField("information") else None
        ),
        weak_directions=np.array(weak).reshape(-1, 6),
        alternatives=tuple(
            Alternative(
                T_target_source=transform_from_proto(other.T_target_source, "T_target_source"),
                scale=other.scale,
                fitness=other.fitness,
                score=other.score,
            )
            for other in message.alternatives
        ),
        iteration_count=message.iteration_count or None,
    )
