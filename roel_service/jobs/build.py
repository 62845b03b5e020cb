"""Inputs to map file and report: the one step that the command line and the children share."""

from __future__ import annotations

import dataclasses
import hashlib
import platform
import resource
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import version

from roel_service import __version__
from roel_service.config.load import to_tables, to_toml
from roel_service.config.stages import Config, RegisterConfig, RuntimeConfig
from roel_service.errors import NoAnswerError
from roel_service.jobs.inputs import BuildParameters
from roel_service.mapping.pipeline import build_line_map
from roel_service.progress import ProgressCallback, ignore
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventSource, EventStream
from roel_service.scene.lines import LineMap
from roel_service.scene.results import MAPPING_STAGES
from roel_service.scene.trajectory import Trajectory
from roel_service.store.builds import BuiltVersion
from roel_service.wire.provenance import EventDigest, Provenance, camera_digest, poses_digest
from roel_service.wire.results import Report
from roel_service.wire.rlm import decode_map, encode_map

# Fewer lines fix no pose in space, so nothing can be done with such a map.
MIN_LINE_COUNT = 3

# Distributions whose release can change a result.
LIBRARIES = ("numpy", "scipy", "numba", "torch", "opencv-contrib-python-headless")

# getrusage counts kibibytes, on macOS bytes.
MAX_RSS_PER_MIB = 2**20 if sys.platform == "darwin" else 2**10


@dataclass(frozen=True, eq=False, kw_only=True)
class BuiltMap:
    """A finished map.

    Attributes:
        rlm_bytes: the map file.
        line_map: the lines as the file holds them.
        trajectory: the poses of the map; those that were given unless they were refined.
        report: with the keys that `roel map build` prints.
    """

    rlm_bytes: bytes
    line_map: LineMap
    trajectory: Trajectory
    report: Report


def run_build(parameters: BuildParameters, progress: ProgressCallback) -> BuiltVersion:
    """Entry point of a build in a child; errors as of `build_map`."""
    events, trajectory, camera = parameters.open()
    built = build_map(events, trajectory, camera, parameters.config, progress)
    ends = built.line_map.segments.reshape(-1, 3)
    return BuiltVersion(
        rlm_bytes=built.rlm_bytes,
        line_count=len(built.line_map),
        bounds_m=[*ends.min(axis=0).tolist(), *ends.max(axis=0).tolist()],
        report=built.report,
        provenance=asdict(decode_map(built.rlm_bytes).provenance),
    )


def build_map(
    events: EventSource,
    trajectory: Trajectory,
    camera: Camera,
    config: Config,
    progress: ProgressCallback = ignore,
) -> BuiltMap:
    """Build a map and pack it; equal inputs give equal bytes, here and on a server.

    Raises:
        NoAnswerError: TOO_FEW_LINES, with the report as its result.
        RoelError: whatever the source of events and the pipeline raise.
    """
    start_s = time.perf_counter()
    source = _DigestedSource(events)
    result = build_line_map(source, trajectory, camera, config, progress=progress)
    provenance = Provenance(
        config_digest=config_digest(config),
        events_sha256=source.digest.hexdigest(),
        poses_sha256=poses_digest(trajectory),
        camera_sha256=camera_digest(camera),
    )
    rlm_bytes = encode_map(result.line_map, provenance)
    line_map = decode_map(rlm_bytes).line_map
    report = {
        "frame_count": result.report.frame_count,
        "event_count": result.report.event_count,
        "line_count": len(line_map),
        "seconds": {stage: result.report.seconds.get(stage, 0.0) for stage in MAPPING_STAGES},
        "seconds_total": time.perf_counter() - start_s,
        "peak_rss_mib": peak_rss_mib(),
        "config": to_tables(config),
        "versions": versions(),
    }
    if len(line_map) < MIN_LINE_COUNT:
        expected = f"at least {MIN_LINE_COUNT} lines"
        found = f"{len(line_map)}"
        raise NoAnswerError("map", expected, found, reason="TOO_FEW_LINES", result=report)
    return BuiltMap(
        rlm_bytes=rlm_bytes, line_map=line_map, trajectory=result.trajectory, report=report
    )


def config_digest(config: Config) -> str:
    """Digest of every parameter that can change a map; the number of workers cannot."""
    runtime = RuntimeConfig(seed=config.runtime.seed)
    text = to_toml(dataclasses.replace(config, runtime=runtime, register=RegisterConfig()))
    return f"sha256:{hashlib.sha256(text.encode()).hexdigest()}"


def peak_rss_mib() -> float:
    """Largest resident memory so far of this process and its children together."""
    usages = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_maxrss for usage in usages) / MAX_RSS_PER_MIB


def versions() -> dict[str, str]:
    """Releases of this project, Python and the libraries that calculate."""
    found = {name: version(name) for name in LIBRARIES}
    found |= {"roel_service": __version__, "python": platform.python_version()}
    return dict(sorted(found.items()))


class _DigestedSource:
    """A source that takes the digest of the events while they pass by, each time anew."""

    def __init__(self, source: EventSource) -> None:
        self._source = source
        self.digest = EventDigest()

    @property
    def width(self) -> int:
        return self._source.width

    @property
    def height(self) -> int:
        return self._source.height

    @property
    def time_range_us(self) -> tuple[int, int] | None:
        return self._source.time_range_us

    def chunks(self) -> Iterator[EventStream]:
        """The chunks of the source."""
        self.digest = EventDigest()
        for chunk in self._source.chunks():
            self.digest.update(chunk)
            yield chunk
