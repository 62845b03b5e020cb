"""What makes a map of a scene: this project's variants, and the methods it is compared with."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from roel_bench.peers.el_slam import ElSlamSettings
from roel_bench.peers.el_slam import map_segments as el_slam_segments
from roel_bench.peers.emvs import EmvsSettings
from roel_bench.peers.emvs import map_points as emvs_points
from roel_bench.peers.limap import LIMAP_SETTINGS, LimapSettings
from roel_bench.peers.limap import map_segments as limap_segments
from roel_bench.results import config_digest, digest_of
from roel_bench.scenes import Scene
from roel_bench.variants import VARIANTS, Variant
from roel_service.arrays import FloatArray
from roel_service.errors import ConfigError, InputError
from roel_service.mapping.pipeline import build_line_map
from roel_service.progress import ProgressCallback
from roel_service.scene.lines import LineMap
from roel_service.scene.trajectory import Trajectory


@dataclass(frozen=True, eq=False, kw_only=True)
class Mapped:
    """A map and how it came about.

    Attributes:
        entities: the lines, or (P, 3) points in m, of which the map is made.
        seconds: wall-clock time of each stage.
        frame_count: frames looked at; 0 for a method without frames.
        event_count: events used; 0 where the method does not count them.
    """

    entities: LineMap | FloatArray
    seconds: dict[str, float]
    frame_count: int = 0
    event_count: int = 0


@dataclass(frozen=True, kw_only=True)
class Method:
    """Something that makes maps.

    Attributes:
        name: as the tables call it.
        digest: of all its parameters.
        run: makes the map of a scene with poses; raises `NoAnswerError` where a peer fails.
    """

    name: str
    digest: str
    run: Callable[[Scene, ProgressCallback], Mapped]


# What a peer makes of a scene: (P, 3) points, m, or lines.
PeerMap = Callable[[Scene, Trajectory, ProgressCallback], LineMap | FloatArray]


def _poses(scene: Scene) -> Trajectory:
    if scene.trajectory is None:
        raise InputError(scene.name, "a scene with poses", "none")
    return scene.trajectory


def from_variant(variant: Variant) -> Method:
    """The pipeline with the configuration of a variant."""
    config = variant.config

    def run(scene: Scene, progress: ProgressCallback) -> Mapped:
        result = build_line_map(
            scene.events, _poses(scene), scene.camera, config, progress=progress
        )
        report = result.report
        return Mapped(
            entities=result.line_map,
            seconds=dict(report.seconds),
            frame_count=report.frame_count,
            event_count=report.event_count,
        )

    return Method(name=variant.name, digest=config_digest(config), run=run)


def _peer(name: str, settings: object, make: PeerMap) -> Method:
    """A method of somebody else's, timed as a whole."""

    def run(scene: Scene, progress: ProgressCallback) -> Mapped:
        began = time.perf_counter()
        entities = make(scene, _poses(scene), progress)
        return Mapped(entities=entities, seconds={"map": time.perf_counter() - began})

    return Method(name=name, digest=digest_of(repr(settings)), run=run)


def _emvs(settings: EmvsSettings) -> Method:
    """EMVS with EVO's keyframes; the one peer whose map is points."""

    def make(scene: Scene, poses: Trajectory, progress: ProgressCallback) -> FloatArray:
        return emvs_points(scene.events, poses, scene.camera, settings, progress)

    return _peer("EMVS", settings, make)


def _el_slam(settings: ElSlamSettings) -> Method:
    """The mapping of EL-SLAM."""

    def make(scene: Scene, poses: Trajectory, progress: ProgressCallback) -> LineMap:
        return LineMap.from_segments(
            el_slam_segments(scene.events, poses, scene.camera, settings, progress)
        )

    return _peer("EL-SLAM", settings, make)


def _limap(name: str, settings: LimapSettings) -> Method:
    """LIMAP on event images."""

    def make(scene: Scene, poses: Trajectory, progress: ProgressCallback) -> LineMap:
        return LineMap.from_segments(
            limap_segments(scene.events, poses, scene.camera, settings, progress)
        )

    return _peer(f"LIMAP: {name}", settings, make)


PEERS = {
    method.name: method
    for method in (
        _emvs(EmvsSettings()),
        _el_slam(ElSlamSettings()),
        *(_limap(name, settings) for name, settings in LIMAP_SETTINGS.items()),
    )
}


def find_method(name: str) -> Method:
    """The variant or peer of that name; raises `ConfigError` for an unknown one."""
    if name in PEERS:
        return PEERS[name]
    if name in VARIANTS:
        return from_variant(VARIANTS[name])
    expected = (
        f"a preset, one of {', '.join(PEERS)}, or a variant such as 'default without smoothing'"
    )
    raise ConfigError("method", expected, repr(name))
