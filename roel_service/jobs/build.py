"""Inputs to map file and report: the one step that the command line and the children share."""

from __future__ import annotations

import dataclasses
import hashlib
import platform
import resource
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import version

import numpy as np

from roel_service import __version__
from roel_service.config.load import to_tables, to_toml
from roel_service.config.stages import AFTER_MAPPING, Config, RuntimeConfig
from roel_service.errors import NoAnswerError
from roel_service.jobs.following import follow
from roel_service.jobs.inputs import BuildParameters, FollowParameters
from roel_service.jobs.stage_files import StageFiles
from roel_service.jobs.task import Partial, Tell
from roel_service.mapping.front_end import NO_KNOWN_FRAMES, KnownFrames
from roel_service.mapping.pipeline import NO_CACHE, build_line_map
from roel_service.mapping.stage_cache import StageCache
from roel_service.progress import ProgressCallback, ignore
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventSource, EventStream
from roel_service.scene.lines import LineMap
from roel_service.scene.results import MAPPING_STAGES
from roel_service.scene.trajectory import Trajectory
from roel_service.store.builds import BuiltVersion
from roel_service.wire.nouns import trajectory_to_proto
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
        line_map, provenance: as the file holds them.
        trajectory: the poses of the map; those that were given unless they were refined.
        report: with the keys that `roel map build` prints.
    """

    rlm_bytes: bytes
    line_map: LineMap
    provenance: Provenance
    trajectory: Trajectory
    report: Report


def run_build(parameters: BuildParameters | FollowParameters, tell: Tell) -> BuiltVersion:
    """Entry point of a build in a child; errors as of `build_map` and `follow`."""
    known = NO_KNOWN_FRAMES
    if isinstance(parameters, FollowParameters):
        known, parameters = follow(parameters, tell)
    events, trajectory, camera = parameters.open()
    built = build_map(
        events,
        trajectory,
        camera,
        parameters.config,
        tell,
        cache=_cache(parameters),
        known=known,
        on_preview=lambda preview: tell(Partial(result=built_version(preview, with_poses=False))),
    )
    return built_version(built, with_poses=parameters.config.refine.free_poses)


def build_map(
    events: EventSource,
    trajectory: Trajectory,
    camera: Camera,
    config: Config,
    progress: ProgressCallback = ignore,
    *,
    cache: StageCache = NO_CACHE,
    known: KnownFrames = NO_KNOWN_FRAMES,
    on_preview: Callable[[BuiltMap], None] | None = None,
) -> BuiltMap:
    """Build a map and pack it; equal inputs give equal bytes, here and on a server.

    Args:
        cache, known: as of `build_line_map`.
        on_preview: gets a first map before its refinement, if that is one; without a report.

    Raises:
        NoAnswerError: TOO_FEW_LINES, with the report as its result.
        RoelError: whatever the source of events and the pipeline raise.
    """
    start_s = time.perf_counter()
    source = _DigestedSource(events)

    def pack(line_map: LineMap, report: Report) -> BuiltMap:
        provenance = Provenance(
            config_digest=config_digest(config),
            events_sha256=_events_sha256(source, cache),
            poses_sha256=poses_digest(trajectory),
            camera_sha256=camera_digest(camera),
        )
        rlm_bytes = encode_map(line_map, provenance)
        packed = decode_map(rlm_bytes)
        return BuiltMap(
            rlm_bytes=rlm_bytes,
            line_map=packed.line_map,
            provenance=packed.provenance,
            trajectory=trajectory,
            report=report,
        )

    def tell_preview(line_map: LineMap) -> None:
        if on_preview is None or len(line_map) < MIN_LINE_COUNT:
            return
        preview = pack(line_map, {})
        if len(preview.line_map) >= MIN_LINE_COUNT:
            on_preview(preview)

    result = build_line_map(
        source,
        trajectory,
        camera,
        config,
        progress=progress,
        cache=cache,
        known=known,
        on_preview=tell_preview if on_preview is not None else None,
    )
    built = pack(result.line_map, {})
    line_count = len(built.line_map)
    report = {
        "frame_count": result.report.frame_count,
        "event_count": result.report.event_count,
        "line_count": line_count,
        "seconds": {stage: result.report.seconds.get(stage, 0.0) for stage in MAPPING_STAGES},
        "seconds_total": time.perf_counter() - start_s,
        "peak_rss_mib": peak_rss_mib(),
        "config": to_tables(config),
        "versions": versions(),
    }
    if line_count < MIN_LINE_COUNT:
        expected = f"at least {MIN_LINE_COUNT} lines"
        reason = "TOO_FEW_LINES"
        raise NoAnswerError("map", expected, f"{line_count}", reason=reason, result=report)
    return dataclasses.replace(built, trajectory=result.trajectory, report=report)


def config_digest(config: Config) -> str:
    """Digest of every parameter that can change a map; the number of workers cannot."""
    runtime = RuntimeConfig(seed=config.runtime.seed)
    defaults = Config()
    others = {table: getattr(defaults, table) for table in AFTER_MAPPING}
    of_maps = dataclasses.replace(config, runtime=runtime, **others)
    text = to_toml(of_maps)
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


def built_version(built: BuiltMap, *, with_poses: bool) -> BuiltVersion:
    """A map as its version's row has it, with its poses if they are not those of the recording."""
    poses = trajectory_to_proto(built.trajectory).SerializeToString() if with_poses else b""
    return BuiltVersion(
        trajectory=bytes(poses),
        rlm_bytes=built.rlm_bytes,
        line_count=len(built.line_map),
        bounds_m=built.line_map.bounds_m.ravel().tolist(),
        report=built.report,
        provenance=asdict(built.provenance),
    )


def _cache(parameters: BuildParameters) -> StageCache:
    if parameters.cache is None:
        return NO_CACHE
    place = parameters.cache
    return StageFiles(place.folder, parameters.recording_digest, place.max_bytes)


def _events_sha256(source: _DigestedSource, cache: StageCache) -> str:
    """Digest of all events; they are read for it alone where nothing else needed them."""
    if not source.was_read:
        kept = cache.get("events", None)
        if kept is not None:
            return bytes(kept["sha256"]).hex()
        for _ in source.chunks():
            pass
    sha256 = source.digest.hexdigest()
    cache.keep("events", None, {"sha256": np.frombuffer(bytes.fromhex(sha256), np.uint8)})
    return sha256


class _DigestedSource:
    """A source that takes the digest of the events while they pass by, each time anew."""

    def __init__(self, source: EventSource) -> None:
        self._source = source
        self.digest = EventDigest()
        self.was_read = False

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
        self.digest, self.was_read = EventDigest(), False
        for chunk in self._source.chunks():
            self.digest.update(chunk)
            yield chunk
        self.was_read = True
