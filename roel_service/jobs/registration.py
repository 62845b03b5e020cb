"""Answers to `RegisterQuestion`, in a child."""

from __future__ import annotations

import hashlib
import time

import numpy as np

from roel_service.io.clouds import cloud_of_points, read_cloud
from roel_service.jobs.preparations import Origin, Preparations
from roel_service.jobs.questions import MapFile, RegisterQuestion, StoredFile
from roel_service.naming import naming
from roel_service.register.prepare import PreparedCloud, prepare_cloud, prepare_map
from roel_service.register.register import register_map
from roel_service.scene.clouds import PointCloud
from roel_service.v1 import registration_pb2
from roel_service.wire.registration import registration_to_proto


def answer(
    question: RegisterQuestion, preparations: Preparations
) -> registration_pb2.RegisterResponse:
    """Where the map lies; a target that was met before is not prepared again.

    Raises:
        NoAnswerError: fewer than three lines.
        CloudError: a cloud that cannot be used, or of another unit than the map.
        CorruptionError: a file that is not what its digest says.
    """
    start_s = time.perf_counter()
    source = question.source.line_map()
    target = _prepared(question, preparations)
    prepared_s = time.perf_counter()
    with naming({"map": question.source.name}):
        result = register_map(
            source,
            target,
            question.config,
            method=question.method,
            T_init=question.T_init,
            vertical=question.vertical,
        )
    message = registration_to_proto(result)
    message.map_version = question.source.name
    message.target_map_version = _version(question.target)
    message.preparation_seconds = prepared_s - start_s
    message.seconds = time.perf_counter() - prepared_s
    return message


def _prepared(question: RegisterQuestion, preparations: Preparations) -> PreparedCloud:
    target, config = question.target, question.config
    if isinstance(target, MapFile):
        origin = Origin(kind="register_map", sha256=target.sha256, parameters=config)
        return preparations.of(
            origin,
            lambda: prepare_map(target.line_map(), config),
            PreparedCloud.from_arrays,
            question.cache,
        )
    if isinstance(target, StoredFile):
        sha256, cache = target.sha256, question.cache
    else:
        # A cloud that came with its request hardly comes again after this child is gone.
        sha256, cache = hashlib.sha256(target).hexdigest(), None
    origin = Origin(kind="register_cloud", sha256=sha256, parameters=config)
    return preparations.of(
        origin, lambda: prepare_cloud(_cloud(target), config), PreparedCloud.from_arrays, cache
    )


def _cloud(target: StoredFile | bytes) -> PointCloud:
    if isinstance(target, bytes):
        return cloud_of_points(np.frombuffer(target, "<f4").reshape(-1, 3), "points")
    with naming({str(target.path): target.name}):
        return read_cloud(target.checked_path())


def _version(target: MapFile | StoredFile | bytes) -> str:
    return target.name if isinstance(target, MapFile) else ""
