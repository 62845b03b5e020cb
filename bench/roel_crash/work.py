"""A build that needs no algorithm: some stages, a preview, and a map that follows from the events."""

from __future__ import annotations

import hashlib
import time

import numpy as np

from roel_service.arrays import Array
from roel_service.config.load import to_tables
from roel_service.jobs.following import OpenRecording
from roel_service.jobs.inputs import BuildParameters, FollowParameters, sealed_parameters
from roel_service.jobs.stage_files import StageFiles
from roel_service.jobs.task import Partial, Tell
from roel_service.progress import Progress
from roel_service.scene.lines import LineMap
from roel_service.scene.results import MAPPING_STAGES
from roel_service.store.builds import BuiltVersion
from roel_service.store.store import recordings_of
from roel_service.wire.provenance import Provenance
from roel_service.wire.rlm import encode_map

# Long enough to be killed in, short enough for hundreds of builds.
STAGE_S = 0.05


def build(parameters: BuildParameters | FollowParameters, tell: Tell) -> BuiltVersion:
    """Entry point: reads every event, while they come or when all are there."""
    if isinstance(parameters, FollowParameters):
        parameters = _followed(parameters)
    _, trajectory, _ = parameters.open()
    digest, event_count = _events_digest(parameters)
    seed = int.from_bytes(digest[:8], "little")
    for index, stage in enumerate(MAPPING_STAGES):
        progress = Progress(stage=stage, done_count=1, total_count=1, fraction=index / 7)
        tell(progress)
        time.sleep(STAGE_S)
        if stage == "triangulate":
            tell(Partial(result=_built(parameters, seed + 1, event_count, len(trajectory))))
    return _built(parameters, seed, event_count, len(trajectory))


def _followed(parameters: FollowParameters) -> BuildParameters:
    """The inputs of a build, once the recording is sealed; what came before must be a part of it."""
    with recordings_of(parameters.folder) as streams:
        recording = OpenRecording(streams, parameters.stream_id, parameters.patience_s)
        early = [chunk.t_us for chunk, _ in recording.chunks()]
        stream = streams.get(parameters.stream_id)
        sealed = sealed_parameters(streams, stream, parameters.config, parameters.cache)
    events, _, _ = sealed.open()
    for t_us, chunk in zip(early, events.chunks(), strict=False):
        if not np.array_equal(t_us, chunk.t_us):
            raise AssertionError("a sealed recording differs from what was durable before")
    return sealed


def _events_digest(parameters: BuildParameters) -> tuple[bytes, int]:
    """Digest and count of all events, from the cache of stages if they are there."""
    assert parameters.cache is not None
    cache = StageFiles(
        parameters.cache.folder, parameters.recording_digest, parameters.cache.max_bytes
    )
    found = cache.get("events", None)
    if found is None:
        found = _counted(parameters)
        cache.keep("events", None, found)
    elif any(
        not np.array_equal(found[name], value) for name, value in _counted(parameters).items()
    ):
        raise AssertionError("the cache of stages holds something else than was found")
    return found["digest"].tobytes(), int(found["event_count"])


def _counted(parameters: BuildParameters) -> dict[str, Array]:
    events, _, _ = parameters.open()
    digest, event_count = hashlib.sha256(), 0
    for chunk in events.chunks():
        digest.update(chunk.t_us.tobytes())
        event_count += len(chunk)
    return {
        "digest": np.frombuffer(digest.digest(), np.uint8),
        "event_count": np.array(event_count),
    }


def _built(
    parameters: BuildParameters, seed: int, event_count: int, frame_count: int
) -> BuiltVersion:
    segments = np.random.default_rng(seed).uniform(-5.0, 5.0, (20, 2, 3))
    ends = segments.reshape(-1, 3)
    return BuiltVersion(
        rlm_bytes=encode_map(LineMap.from_segments(segments), Provenance()),
        line_count=len(segments),
        bounds_m=[*ends.min(axis=0).tolist(), *ends.max(axis=0).tolist()],
        report={
            "frame_count": frame_count,
            "event_count": event_count,
            "line_count": len(segments),
            "seconds": dict.fromkeys(MAPPING_STAGES, STAGE_S),
            "seconds_total": STAGE_S * len(MAPPING_STAGES),
            "peak_rss_mib": 1.0,
            "config": to_tables(parameters.config),
            "versions": {},
        },
    )
