"""A build that needs no algorithm: some stages, a preview, and a map that follows from the events."""

from __future__ import annotations

import hashlib
import time

import numpy as np

from roel_service.config.load import to_tables
from roel_service.jobs.inputs import BuildParameters
from roel_service.jobs.task import Partial, Tell
from roel_service.progress import Progress
from roel_service.scene.lines import LineMap
from roel_service.scene.results import MAPPING_STAGES
from roel_service.store.builds import BuiltVersion
from roel_service.wire.provenance import Provenance
from roel_service.wire.rlm import encode_map

# Long enough to be killed in, short enough for hundreds of builds.
STAGE_S = 0.05


def build(parameters: BuildParameters, tell: Tell) -> BuiltVersion:
    """Entry point: reads every event."""
    events, trajectory, _ = parameters.open()
    digest, event_count = hashlib.sha256(), 0
    for chunk in events.chunks():
        digest.update(chunk.t_us.tobytes())
        event_count += len(chunk)
    seed = int.from_bytes(digest.digest()[:8], "little")
    for index, stage in enumerate(MAPPING_STAGES):
        progress = Progress(stage=stage, done_count=1, total_count=1, fraction=index / 7)
        tell(progress)
        time.sleep(STAGE_S)
        if stage == "triangulate":
            tell(Partial(result=_built(parameters, seed + 1, event_count, len(trajectory))))
    return _built(parameters, seed, event_count, len(trajectory))


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
