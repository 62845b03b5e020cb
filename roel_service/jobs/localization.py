"""Answers to `LocalizeQuestion`, in a child."""

from __future__ import annotations

import time
from collections.abc import Sequence

from roel_service.arrays import Array
from roel_service.io.images import decode_panorama, decode_photograph
from roel_service.jobs.preparations import Origin, Preparations
from roel_service.jobs.questions import LocalizeQuestion, MapFile, StoredFile
from roel_service.pano_loc.localize import localize_panorama, localize_photograph
from roel_service.pano_loc.prepare import PreparedMap, prepare_map
from roel_service.pano_loc.warm import warm_up
from roel_service.scene.results import PanoLocResult
from roel_service.v1 import localization_pb2
from roel_service.wire.localization import localization_to_proto

SUBJECT = "image"


def answer(
    question: LocalizeQuestion, preparations: Preparations
) -> localization_pb2.LocalizeResponse:
    """Where the picture was taken; a map that was met before is not prepared again.

    Raises:
        PanoramaError: no picture that can be used.
        CorruptionError: a file that is not what its digest says.
    """
    warm_up()
    start_s = time.perf_counter()
    grey = _decoded(question)
    decoded_s = time.perf_counter()
    maps = [_prepared(file, question, preparations) for file in question.maps]
    prepared_s = time.perf_counter()
    result = _located(grey, maps, question)
    end_s = time.perf_counter()
    names = [file.name for file in question.maps]
    message = localization_to_proto(result, names, question.max_hypothesis_count)
    message.stage_seconds["decode"] = decoded_s - start_s
    message.stage_seconds["prepare"] = prepared_s - decoded_s
    message.stage_seconds["localize"] = message.seconds = end_s - prepared_s
    return message


def _decoded(question: LocalizeQuestion) -> Array:
    """(H, W) uint8 grey values."""
    data = _bytes(question.image)
    if question.camera is None:
        return decode_panorama(data, SUBJECT)
    return decode_photograph(data, question.camera, SUBJECT)


def _located(grey: Array, maps: Sequence[PreparedMap], question: LocalizeQuestion) -> PanoLocResult:
    config, prior, gravity = question.config, question.prior, question.gravity
    if question.camera is None or prior is None:
        return localize_panorama(grey, maps, config, prior=prior, gravity=gravity)
    return localize_photograph(grey, question.camera, maps, config, prior=prior, gravity=gravity)


def _bytes(image: StoredFile | bytes) -> bytes:
    return image if isinstance(image, bytes) else image.read()


def _prepared(file: MapFile, question: LocalizeQuestion, preparations: Preparations) -> PreparedMap:
    config = question.config
    origin = Origin(kind="localize_map", sha256=file.sha256, parameters=config)
    return preparations.of(
        origin,
        lambda: prepare_map(file.line_map(), config),
        PreparedMap.from_arrays,
        question.cache,
    )
