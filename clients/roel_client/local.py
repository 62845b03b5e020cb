"""The commands' work in this process: the only module of the client that loads algorithms.

Each function imports what it needs when it is called, so that importing this module costs nothing.
Files are named as the user gave them, because errors repeat the name.
"""

from __future__ import annotations

import asyncio
import dataclasses
import hashlib
import logging
import time
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import AsyncExitStack, ExitStack, asynccontextmanager, contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from roel_service.naming import naming
from roel_service.wire.names import is_resource_name

if TYPE_CHECKING:
    from roel_client.batch import Locate, Located, Query
    from roel_client.client import Client
    from roel_service.arrays import Array
    from roel_service.config.stages import Config, LocalizeConfig, RegisterConfig
    from roel_service.geometry.se3 import SE3
    from roel_service.io.events import EventFile
    from roel_service.progress import ProgressCallback
    from roel_service.scene.camera import Camera
    from roel_service.scene.clouds import PointCloud
    from roel_service.scene.lines import LineMap
    from roel_service.scene.results import PanoLocResult, RegistrationResult
    from roel_service.scene.trajectory import Trajectory
    from roel_service.v1.types_pb2 import BlobRef
    from roel_service.wire.rlm import MapFile

RLM_MAGIC = b"RLM1"
# A message has 4 MiB.
MAX_INLINE_BYTES = 3_500_000
US_PER_DAY = 24 * 3600 * 1_000_000


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording:
    """An opened recording; events are read when somebody asks for them.

    Attributes:
        names: what the user called the files, by what errors call them.
    """

    events: EventFile
    trajectory: Trajectory
    camera: Camera
    names: dict[str, str]


@dataclass(frozen=True, eq=False, kw_only=True)
class Built:
    """A finished map as a file's bytes, and the report of its build.

    Attributes:
        trajectory: the poses of the map; None where they are those that were given.
    """

    rlm_bytes: bytes
    report: dict[str, Any]
    trajectory: Trajectory | None = None


def open_recording(
    events: str, poses: str, camera: str, sensor_size: tuple[int, int] | None
) -> Recording:
    """Open the three files of a recording; raises `InputError` for the first that is unusable."""
    from roel_service.io.camera import read_camera
    from roel_service.io.events import open_events
    from roel_service.io.poses import read_trajectory

    calibration = read_camera(Path(camera), sensor_size)
    trajectory = read_trajectory(Path(poses))
    source = open_events(Path(events), calibration.width, calibration.height)
    names = {"events": events, "poses": poses, "camera": camera}
    return Recording(events=source, trajectory=trajectory, camera=calibration, names=names)


def build_map(recording: Recording, config: Config, progress: ProgressCallback) -> Built:
    """Build a map in this process.

    Raises:
        NoAnswerError: fewer lines than a map needs.
        RoelError: whatever reading and building raise.
    """
    from roel_service.jobs import build

    with naming(recording.names):
        built = build.build_map(
            recording.events, recording.trajectory, recording.camera, config, progress
        )
    return Built(rlm_bytes=built.rlm_bytes, report=built.report, trajectory=built.trajectory)


def build_map_remotely(
    recording: Recording,
    config: Config,
    progress: ProgressCallback,
    server: str,
    options: dict[str, Any],
) -> Built:
    """Let a server build the map; raises as `build_map`, and `UnavailableError`.

    Args:
        server: `HOST:PORT`.
        options: arguments of `Client` beside the address.
    """
    from roel_client.client import Client

    with naming(recording.names), Client(server, **options) as client:
        rlm_bytes, report, trajectory = client.map_recording_with_poses(
            recording.events, recording.trajectory, recording.camera, config, progress
        )
    return Built(rlm_bytes=rlm_bytes, report=report, trajectory=trajectory)


def draw_map(built: Built, recording: Recording, path: Path) -> None:
    """Write the picture of a map."""
    from roel_service.evaluation import figures
    from roel_service.wire.rlm import decode_map

    line_map = decode_map(built.rlm_bytes).line_map
    trajectory = built.trajectory or recording.trajectory
    figures.draw_map(line_map, trajectory, recording.camera, recording.events, path)


def write_poses(trajectory: Trajectory, path: Path) -> None:
    """Write poses as TUM text."""
    from roel_service.io.poses import write_trajectory

    write_trajectory(path, trajectory)


def refine_poses(
    recording: Recording,
    map_name: str | None,
    config: Config,
    out: Path,
    *,
    estimate_time_offset: bool,
    progress: ProgressCallback,
) -> tuple[dict[str, Any], Trajectory]:
    """Refine the poses of a recording, with its own lines or in a map, and write them.

    Returns:
        What `roel refine-poses` prints, and the poses.

    Raises:
        NoAnswerError: too few lines.
        RoelError: whatever reading and refining raise.
    """
    from roel_service.jobs import refinement

    started_s = time.perf_counter()
    line_map = None if map_name is None else _read_map(map_name)
    with naming(recording.names):
        trajectory, report = refinement.refine_poses(
            recording.events,
            recording.trajectory,
            recording.camera,
            config,
            line_map=line_map,
            estimate_time_offset=estimate_time_offset,
            progress=progress,
        )
    write_poses(trajectory, out)
    return {**report, "seconds": time.perf_counter() - started_s}, trajectory


def refine_poses_remotely(
    recording: Recording,
    map_name: str | None,
    config: Config,
    out: Path,
    progress: ProgressCallback,
    *,
    server: str,
    options: dict[str, Any],
) -> tuple[dict[str, Any], Trajectory]:
    """Let a server refine the poses; as `refine_poses`.

    Args:
        map_name: a file, or a version that the server has.
        server: `HOST:PORT`.
        options: arguments of `Client` beside the address.
    """
    from roel_client.client import Client

    started_s = time.perf_counter()
    with ExitStack() as resources:
        resources.enter_context(naming(recording.names))
        client = resources.enter_context(Client(server, **options))
        version = None
        if map_name is not None:
            version = resources.enter_context(_hosted(client, map_name))
        trajectory, answer = client.refine_recording(
            recording.events, recording.trajectory, recording.camera, config, version, progress
        )
    write_poses(trajectory, out)
    has_sigma = answer.HasField("time_offset_sigma_us")
    result = {
        "pose_count": answer.pose_count,
        "line_count": answer.line_count,
        "iterations": answer.iteration_count,
        "converged": answer.converged,
        "cost_initial": answer.cost_initial,
        "cost_final": answer.cost_final,
        "mean_shift_m": answer.mean_shift_m,
        "mean_turn_deg": answer.mean_turn_deg,
        "time_offset_us": answer.time_offset_us,
        "time_offset_sigma_us": answer.time_offset_sigma_us if has_sigma else None,
        "problems": list(answer.problems),
        "seconds": time.perf_counter() - started_s,
    }
    return result, trajectory


def draw_poses(
    recording: Recording, refined: Trajectory, truth_name: str | None, path: Path
) -> None:
    """Write the picture of given and refined poses, and of the true ones if there are any."""
    from roel_service.evaluation import pose_figures
    from roel_service.io.poses import read_trajectory

    truth = None if truth_name is None else read_trajectory(Path(truth_name))
    pose_figures.draw_trajectories(recording.trajectory, refined, truth, path)


def read_map_file(name: str) -> MapFile:
    """Decode a `.rlm` file."""
    from roel_service.io.files import open_input
    from roel_service.wire.rlm import decode_map

    with open_input(Path(name)) as file:
        return decode_map(file.read(), subject=name)


def describe_map(name: str) -> dict[str, Any]:
    """What a map file holds, with the keys of `roel map info`."""
    map_file = read_map_file(name)
    return {
        "format_version": map_file.format_version[0],
        "line_count": len(map_file.line_map),
        "total_length_m": float(map_file.line_map.lengths_m.sum()),
        "bounds_min_m": map_file.bounds_min_m.tolist(),
        "bounds_max_m": map_file.bounds_max_m.tolist(),
        "bytes": map_file.byte_count,
        "digest": map_file.digest,
        "config_digest": map_file.provenance.config_digest,
    }


def export_map(name: str, path: Path) -> None:
    """Write a map file in the format that the suffix of `path` names."""
    from roel_service.io import maps

    maps.export_map(read_map_file(name).line_map, path)


def import_map(name: str, path: Path) -> tuple[str, int, int]:
    """Write lines of another program as a map file; their format, and lines kept and left out."""
    from roel_service.errors import MapFileError
    from roel_service.io.foreign_maps import read_foreign_map
    from roel_service.wire.provenance import Provenance
    from roel_service.wire.rlm import decode_map, encode_map

    foreign_format, line_map = read_foreign_map(Path(name), name)
    if len(line_map) == 0:
        raise MapFileError(name, "lines", "none")
    rlm_bytes = encode_map(line_map, Provenance())
    path.write_bytes(rlm_bytes)
    map_file = decode_map(rlm_bytes, subject=name)
    return foreign_format, len(map_file.line_map), map_file.dropped_line_count


def evaluate_map(name: str, mesh: str, edges: str) -> dict[str, Any]:
    """The figures of `roel evaluate map`; the map is a `.rlm` file or an exported NPZ."""
    from roel_service.evaluation import maps
    from roel_service.io.clouds import read_mesh, read_points

    line_map = _read_map(name)
    surface = read_mesh(Path(mesh))
    truth = read_points(Path(edges), "edges")
    with naming({"map": name, "mesh": mesh, "edges": edges}):
        return asdict(maps.evaluate_map(line_map, surface, truth))


def _read_map(name: str) -> LineMap:
    from roel_service.io.maps import read_exported_map

    return read_map_file(name).line_map if _is_map_file(name) else read_exported_map(Path(name))


def _is_map_file(name: str) -> bool:
    from roel_service.io.files import open_input

    with open_input(Path(name)) as file:
        return file.read(len(RLM_MAGIC)) == RLM_MAGIC


def register_map(
    name: str,
    cloud_name: str,
    *,
    init: str | None,
    method: str,
    config: RegisterConfig,
    plot: Path | None,
) -> dict[str, Any]:
    """Register a map with a cloud; the keys of `roel register`."""
    from roel_service.evaluation.registration_figures import draw_registration
    from roel_service.geometry.se3 import SE3
    from roel_service.io.transforms import read_transform
    from roel_service.register import register

    T_init = SE3.identity() if init is None else read_transform(Path(init))
    line_map = _read_map(name)
    cloud = _read_target(cloud_name)
    started_s = time.perf_counter()
    with naming({"map": name, "cloud": cloud_name}):
        result = register.register_map(line_map, cloud, config, method=method, T_init=T_init)
    seconds = time.perf_counter() - started_s
    if plot is not None:
        draw_registration(line_map, cloud, T_init, result, plot)
    return _registration_document(result, seconds)


def register_map_remotely(
    name: str,
    cloud_name: str,
    *,
    init: str | None,
    method: str,
    config: RegisterConfig,
    plot: Path | None,
    server: str,
    options: dict[str, Any],
) -> dict[str, Any]:
    """Let a server register a map with a cloud; as `register_map`.

    Args:
        name, cloud_name: files, or names of versions that the server has.
        server: `HOST:PORT`.
        options: arguments of `Client` beside the address.
    """
    from roel_client.client import Client
    from roel_service.evaluation.registration_figures import draw_registration
    from roel_service.geometry.se3 import SE3
    from roel_service.io.transforms import read_transform
    from roel_service.wire.registration import registration_from_proto

    T_init = None if init is None else read_transform(Path(init))
    with (
        naming({"cloud": cloud_name}),
        Client(server, **options) as client,
        _hosted(client, name) as version,
        _hosted_target(client, cloud_name) as target,
        naming({version: name}),
    ):
        message = client.register(version, target, T_init=T_init, method=method, config=config)
    result = registration_from_proto(message)
    if plot is not None:
        start = SE3.identity() if T_init is None else T_init
        draw_registration(_read_map(name), _read_target(cloud_name), start, result, plot)
    return _registration_document(result, message.seconds)


@contextmanager
def _hosted(client: Client, name: str) -> Iterator[str]:
    """Name of a version on the server: one that is there, or a file's for a while."""
    if is_resource_name(name):
        yield name
        return
    with naming({"imported file": name}), client.hosted_map(Path(name)) as version:
        yield version


@contextmanager
def _hosted_target(client: Client, name: str) -> Iterator[str | BlobRef]:
    """The same for what a map is registered with, which may be a cloud."""
    if is_resource_name(name) or _is_map_file(name):
        with _hosted(client, name) as version:
            yield version
    else:
        yield client.upload_blob(Path(name))


def _read_target(name: str) -> PointCloud | LineMap:
    """What a map is registered with: a `.rlm` file, or a cloud of any format."""
    from roel_service.io.clouds import read_cloud

    return read_map_file(name).line_map if _is_map_file(name) else read_cloud(Path(name))


def _registration_document(result: RegistrationResult, seconds: float) -> dict[str, Any]:
    information = result.information
    return {
        "T_target_source": result.T_target_source.matrix().tolist(),
        "scale": result.scale,
        "converged": result.converged,
        "stop_reason": result.stop_reason.value,
        "verdict": result.verdict.value,
        "inside": result.inside,
        "fitness": result.fitness,
        "overlap": result.overlap,
        "agreement": result.agreement,
        "inlier_rmse_m": result.inlier_rmse_m,
        "information": None if information is None else information.tolist(),
        "weak_directions": result.weak_directions.tolist(),
        "alternatives": [
            {
                "T_target_source": other.T_target_source.matrix().tolist(),
                "scale": other.scale,
                "fitness": other.fitness,
                "score": other.score,
            }
            for other in result.alternatives
        ],
        "iteration_count": result.iteration_count,
        "seconds": seconds,
    }


class TrackedRecording:
    """The camera of a recording, followed in a map.

    Args:
        map_name, events, camera, init: files; `init` holds the first T_world_camera.
        sensor_size: for a calibration that does not say it.
        config: parameters.

    Raises:
        InputError: the first file that cannot be used.
        NoAnswerError: TOO_FEW_LINES in the map.
    """

    def __init__(
        self,
        map_name: str,
        events: str,
        camera: str,
        sensor_size: tuple[int, int] | None,
        init: str,
        config: Config,
    ) -> None:
        from roel_service.io.camera import read_camera
        from roel_service.io.events import open_events
        from roel_service.io.transforms import read_transform
        from roel_service.tracking.tracker import PoseTracker

        calibration = read_camera(Path(camera), sensor_size)
        guess = read_transform(Path(init))
        self._names = {"events": events, "map": map_name}
        self._events = open_events(Path(events), calibration.width, calibration.height)
        line_map = _read_map(map_name)
        with naming(self._names):
            self._tracker = PoseTracker(
                line_map, calibration, config.track, guess, config.runtime.seed
            )
        self._relied_on: list[tuple[int, SE3]] = []

    def documents(self) -> Iterator[dict[str, Any]]:
        """What `roel track` prints, pose by pose."""
        from roel_service.scene.results import PoseStatus

        with naming(self._names):
            for chunk in self._events.chunks():
                for pose in self._tracker.push(chunk):
                    T, covariance = pose.T_world_camera, pose.covariance
                    if T is not None and pose.status is PoseStatus.TRACKING:
                        self._relied_on.append((pose.t_us, T))
                    yield {
                        "t_us": pose.t_us,
                        "status": pose.status.value,
                        "T_world_camera": None if T is None else T.matrix().tolist(),
                        "covariance": None if covariance is None else covariance.tolist(),
                        "seen_share": pose.seen_share,
                        "sharpness": pose.sharpness,
                        "event_count": pose.event_count,
                    }

    def write(self, out: Path) -> None:
        """Write the poses that may be relied on, at least two, as TUM text."""
        import numpy as np

        from roel_service.geometry.se3 import SE3
        from roel_service.scene.trajectory import Trajectory

        times_us = np.array([t_us for t_us, _ in self._relied_on])
        poses = SE3.from_matrix(np.stack([pose.matrix() for _, pose in self._relied_on]))
        write_poses(Trajectory(t_us=times_us, T_world_camera=poses), out)


def localize_panoramas(
    names: list[str],
    panorama_names: list[str],
    *,
    method: str,
    prior: str | None,
    config: LocalizeConfig,
    overlay: Path | None,
    camera: str | None = None,
) -> Iterator[dict[str, Any]]:
    """Locate panoramas in one of a few maps; for each the keys of `roel localize`.

    Every file is read once before the first panorama is located.

    Args:
        names: of the maps.
        panorama_names: files.
        method: `default`, `fgpl` or `fgpl-released`.
        prior: file with the first T_world_panorama, for the default alone.
        config: parameters of the default, and of the verdict.
        overlay: folder to make, for one picture each.
        camera: file with the camera of photographs, which need a prior; None for panoramas.
    """
    from roel_service.io.camera import read_camera
    from roel_service.io.images import read_panorama, read_photograph
    from roel_service.io.transforms import read_transform

    line_maps = [_read_map(name) for name in names]
    T_prior = None if prior is None else read_transform(Path(prior))
    lens = None if camera is None else read_camera(Path(camera))

    def read(picture_name: str) -> Array:
        path = Path(picture_name)
        return read_panorama(path) if lens is None else read_photograph(path, lens)

    for panorama_name in panorama_names:
        read(panorama_name)
    locate = _locator(method, line_maps, T_prior, lens, config)
    if overlay is not None:
        overlay.mkdir()
    for index, panorama_name in enumerate(panorama_names):
        grey = read(panorama_name)
        started_s = time.perf_counter()
        result = locate(grey)
        seconds = time.perf_counter() - started_s
        if overlay is not None:
            _draw_overlay(overlay, index, panorama_name, line_maps, result)
        yield _localization_document(panorama_name, names, result, seconds)


def _locator(
    method: str,
    line_maps: list[LineMap],
    T_prior: SE3 | None,
    camera: Camera | None,
    config: LocalizeConfig,
) -> Callable[[Array], PanoLocResult]:
    """Prepare maps, and return what locates a grey panorama, or a photograph of a camera."""
    if method == "default":
        from roel_service.pano_loc.hints import PosePrior
        from roel_service.pano_loc.localize import localize_panorama, localize_photograph
        from roel_service.pano_loc.prepare import prepare_map

        prior = None if T_prior is None else PosePrior(T_world_picture=T_prior)
        maps = [prepare_map(line_map, config) for line_map in line_maps]
        if camera is not None and prior is not None:
            return lambda grey: localize_photograph(grey, camera, maps, config, prior=prior)
        return lambda grey: localize_panorama(grey, maps, config, prior=prior)

    from roel_service.pano_loc.fgpl.parameters import VARIANTS
    from roel_service.pano_loc.fgpl.verdict import localize_judged, prepare_judged

    parameters = VARIANTS[method]
    judged = [prepare_judged(line_map, parameters, config) for line_map in line_maps]
    return lambda grey: localize_judged(grey, judged, parameters, config)


def localize_panoramas_remotely(
    names: list[str],
    panorama_names: list[str],
    *,
    prior: str | None,
    config: LocalizeConfig,
    overlay: Path | None,
    server: str,
    options: dict[str, Any],
) -> Iterator[dict[str, Any]]:
    """Let a server locate panoramas; as `localize_panoramas`.

    Args:
        names: of maps: files, or versions that the server has.
        server: `HOST:PORT`.
        options: arguments of `Client` beside the address.
    """
    from roel_client.client import Client
    from roel_service.io.images import read_panorama
    from roel_service.io.transforms import read_transform
    from roel_service.wire.localization import localization_from_proto

    T_prior = None if prior is None else read_transform(Path(prior))
    for panorama_name in panorama_names:
        read_panorama(Path(panorama_name))
    line_maps = []
    if overlay is not None:
        line_maps = [_read_map(name) for name in names]
        overlay.mkdir()
    with Client(server, **options) as client, ExitStack() as hosting:
        versions = [hosting.enter_context(_hosted(client, name)) for name in names]
        for index, panorama_name in enumerate(panorama_names):
            with naming({"image": panorama_name}):
                image = _sent_image(client, Path(panorama_name))
                message = client.localize(versions, image, T_prior=T_prior, config=config)
            result = localization_from_proto(message)
            if overlay is not None:
                _draw_overlay(overlay, index, panorama_name, line_maps, result)
            yield _localization_document(panorama_name, names, result, message.seconds)


def localize_batch(
    manifest: str,
    names: list[str],
    out: str,
    *,
    config: LocalizeConfig,
    worker_count: int | None,
    server: tuple[str, dict[str, Any]] | None,
    progress: ProgressCallback,
) -> dict[str, Any]:
    """Locate the panoramas of a manifest and write a row for each; what `roel batch` prints.

    Args:
        names: of maps: files or, with a server, versions that it has.
        out: the table; beside it lies the journal of a run that was interrupted.
        worker_count: queries at a time; None takes one a core.
        server: its address, and arguments of `Client` beside it; None works in this process.
    """
    from roel_client import batch

    if out.endswith(".parquet"):
        batch.require_parquet(out)
    queries = batch.read_manifest(manifest)
    parallel_count = worker_count or batch.default_worker_count()
    asked = {
        "manifest": hashlib.sha256(Path(manifest).read_bytes()).hexdigest(),
        "maps": [name if is_resource_name(name) else _digest(name) for name in names],
        "config": dataclasses.asdict(config),
    }
    with batch.Journal(Path(f"{out}.partial"), asked) as journal:
        known_count = len(journal.rows)

        async def run() -> None:
            locating = (
                _locating_here(names, config, parallel_count)
                if server is None
                else _locating_there(names, config, *server)
            )
            async with locating as locate:
                await batch.locate_all(
                    queries, locate, journal, parallel_count=parallel_count, progress=progress
                )

        with _first_error():
            asyncio.run(run())
        rows = [journal.rows[query.index] for query in queries]
        batch.write_table(rows, Path(out))
        journal.delete()
    statuses = [row["status"] for row in rows]
    return {
        "query_count": len(rows),
        "found_count": statuses.count("FOUND"),
        "ambiguous_count": statuses.count("AMBIGUOUS"),
        "not_found_count": statuses.count("NOT_FOUND"),
        "failed_count": statuses.count(batch.FAILED),
        "known_count": known_count,
    }


@contextmanager
def _first_error() -> Iterator[None]:
    """Of tasks that failed together, the first one speaks."""
    try:
        yield
    except ExceptionGroup as group:
        raise group.exceptions[0] from None


@asynccontextmanager
async def _locating_here(
    names: list[str], config: LocalizeConfig, worker_count: int
) -> AsyncIterator[Locate]:
    """Locates in children of this process, which stay and keep the prepared maps."""
    from roel_service.jobs.questions import LocalizeQuestion, MapFile
    from roel_service.jobs.task import Limits, TaskSpec
    from roel_service.jobs.warm import WarmExecutor
    from roel_service.pano_loc.hints import PosePrior
    from roel_service.v1 import localization_pb2
    from roel_service.wire.localization import localization_from_proto

    entrypoint = "roel_service.jobs.desk:Desk"
    executor = WarmExecutor(worker_count, worker_count, preload=entrypoint)
    maps = tuple(
        MapFile(name=name, path=Path(name).resolve(), sha256=_digest(name)) for name in names
    )

    async def locate(query: Query) -> Located:
        prior = None if query.T_prior is None else PosePrior(T_world_picture=query.T_prior)
        question = LocalizeQuestion(
            maps=maps,
            image=await asyncio.to_thread(_picture_bytes, query),
            prior=prior,
            camera=None,
            gravity=None,
            max_hypothesis_count=config.max_hypothesis_count,
            config=config,
            cache=None,
        )
        spec = TaskSpec(entrypoint=entrypoint, parameters=question, limits=Limits())
        answer = await executor.run(spec, _ignore_news)
        message = localization_pb2.LocalizeResponse.FromString(answer)
        return _located(localization_from_proto(message), names, message.seconds)

    try:
        yield locate
    finally:
        await executor.close()


@asynccontextmanager
async def _locating_there(
    names: list[str], config: LocalizeConfig, server: str, options: dict[str, Any]
) -> AsyncIterator[Locate]:
    """Locates on a server, which keeps the prepared maps."""
    from roel_client.aio import AsyncClient
    from roel_service.wire.localization import localization_from_proto

    async with AsyncClient(server, **options) as client, AsyncExitStack() as hosting:
        versions = [
            name
            if is_resource_name(name)
            else await hosting.enter_async_context(client.hosted_map(Path(name)))
            for name in names
        ]

        async def locate(query: Query) -> Located:
            image = await asyncio.to_thread(_picture_bytes, query)
            sent = image if len(image) <= MAX_INLINE_BYTES else await client.upload_blob(query.path)
            message = await client.localize(versions, sent, T_prior=query.T_prior, config=config)
            return _located(localization_from_proto(message), names, message.seconds)

        yield locate


def _picture_bytes(query: Query) -> bytes:
    from roel_service.io.files import read_input
    from roel_service.io.images import MAX_FILE_BYTES

    return read_input(query.path, MAX_FILE_BYTES)


def _digest(name: str) -> str:
    """Hexadecimal digest of a map file; raises `MapFileError` for any other file."""
    return read_map_file(name).digest.removeprefix("sha256:")


def _located(result: PanoLocResult, names: list[str], seconds: float) -> Located:
    best = names[result.hypotheses[0].map_index] if result.hypotheses else None
    return result, best, seconds


async def _ignore_news(news: object) -> None:
    """Nobody watches a single query."""


def _sent_image(client: Client, path: Path) -> bytes | BlobRef:
    """A picture as a request has it: itself if it is small enough, else uploaded."""
    if path.stat().st_size > MAX_INLINE_BYTES:
        return client.upload_blob(path)
    return path.read_bytes()


def _draw_overlay(
    folder: Path, index: int, name: str, line_maps: list[LineMap], result: PanoLocResult
) -> None:
    from roel_service.evaluation.panorama_figures import draw_overlay
    from roel_service.io.images import read_panorama

    best = result.hypotheses[0].map_index if result.hypotheses else 0
    path = folder / f"{index:03d}-{Path(name).stem}.png"
    draw_overlay(read_panorama(Path(name)), line_maps[best], result.T_world_panorama, path)


def _localization_document(
    name: str, map_names: list[str], result: PanoLocResult, seconds: float
) -> dict[str, Any]:
    several = len(map_names) > 1
    poses = [
        {"T_world_panorama": item.T_world_panorama.matrix().tolist(), "score": item.score}
        | ({"map": map_names[item.map_index]} if several else {})
        for item in result.hypotheses
    ]
    best = poses[0] if poses else {"T_world_panorama": None}
    return {
        "panorama": name,
        "status": result.status.value,
        **best,
        "score": result.score,
        "covariance": result.hypotheses[0].covariance.tolist() if poses else None,
        "alternatives": poses[1:],
        "reason": None if result.reason is None else result.reason.value,
        "seconds": seconds,
    } | ({"map": best.get("map")} if several else {})


def simulate(folder: Path, seed: int, progress: ProgressCallback, **given: Any) -> int:
    """Write a synthetic recording with its truth; number of its events.

    Args:
        folder: must not exist, or be empty.
        given: fields of `SimulationConfig` that differ from its defaults.
    """
    from roel_service.simulate.dataset import SimulationConfig, simulate_dataset

    return simulate_dataset(folder, SimulationConfig(**given), seed, progress)


def serve(data: Path, listen: dict[str, Any], on_ready: Callable[[dict[str, str]], None]) -> None:
    """Serve until SIGTERM or SIGINT.

    Args:
        listen: fields of `Listen` that differ from its defaults.
        on_ready: is told the `address`, and that of `admin` if there is one.
    """
    from roel_service.service.listen import Listen
    from roel_service.service.server import Addresses, serve

    def tell(addresses: Addresses) -> None:
        admin = {} if addresses.admin is None else {"admin": addresses.admin}
        on_ready({"address": addresses.calls, **admin})

    asyncio.run(serve(data, Listen(**listen), on_ready=tell))


@contextmanager
def log_format(name: str | None) -> Iterator[None]:
    """Write the log in a format that `roel_service.service.logs` names; None leaves it."""
    from roel_service.service.logs import FORMATTERS

    if name is None:
        yield
        return
    handler = logging.StreamHandler()
    handler.setFormatter(FORMATTERS[name]())
    root = logging.getLogger()
    previous = root.handlers
    root.handlers = [handler]
    try:
        yield
    finally:
        root.handlers = previous


def create_token(
    data: Path, name: str, role: str, days: int | None, quota: Mapping[str, int | None]
) -> str:
    """Name a caller of the server on a folder; its token.

    Args:
        quota: fields of `store.quotas.Quota`.
    """
    from roel_service.store.principals import Role
    from roel_service.store.quotas import Quota
    from roel_service.store.records import now_us
    from roel_service.store.store import opened_principals

    expire_time_us = 0 if days is None else now_us() + days * US_PER_DAY
    with opened_principals(data) as principals:
        return principals.create(name, Role[role.upper()], expire_time_us, Quota(**quota))


def list_tokens(data: Path) -> list[dict[str, Any]]:
    """Who may call the server on a folder."""
    from roel_service.store.store import opened_principals

    with opened_principals(data) as principals:
        return [
            {
                "name": item.name,
                "role": item.role.label,
                "created": _iso_time(item.create_time_us),
                "expires": _iso_time(item.expire_time_us) if item.expire_time_us else None,
                "quota": dataclasses.asdict(item.quota),
            }
            for item in principals.list()
        ]


def revoke_token(data: Path, name: str) -> None:
    """Let a caller in no longer; raises `NotFoundError`."""
    from roel_service.store.store import opened_principals

    with opened_principals(data) as principals:
        principals.revoke(name)


def _iso_time(time_us: int) -> str:
    return datetime.fromtimestamp(time_us / 1e6, UTC).isoformat(timespec="seconds")


def check_data(folder: str) -> dict[str, Any]:
    """What a check of a data folder found; raises `NoAnswerError` DATA_UNSOUND for problems."""
    from roel_service.errors import NoAnswerError
    from roel_service.store.fsck import check_folder

    findings = asdict(check_folder(Path(folder)))
    problems = findings["problems"]
    if problems:
        found = f"{len(problems)} problems, first: {problems[0]}"
        reason = "DATA_UNSOUND"
        raise NoAnswerError(folder, "a sound folder", found, reason=reason, result=findings)
    return findings


def back_up_data(folder: str, target: Path) -> dict[str, Any]:
    """Copy a data folder to a new place; what the check of the copy found."""
    from roel_service.store.backup import back_up

    return asdict(back_up(Path(folder), target))


def collect_garbage(folder: str) -> dict[str, Any]:
    """Delete what nobody needs; how much that was. No server may have the folder."""
    from roel_service.errors import InputError
    from roel_service.store.store import Store

    if not (Path(folder) / "rows.sqlite").is_file():
        raise InputError(folder, "a data folder", "none")
    with Store(Path(folder)) as store:
        return asdict(store.collect_garbage())


def bench_mapping(
    out: Path,
    *,
    suite: str,
    scenes: tuple[str, ...] | None,
    methods: tuple[str, ...] | None,
    data: Path | None,
    rooms: Path,
    progress: ProgressCallback,
) -> tuple[dict[str, Any], str]:
    """Run a suite of the benchmark in a folder; all its rows, as a document and as Markdown."""
    from roel_bench import suites, tables
    from roel_bench.catalogue import Places
    from roel_bench.results import to_document
    from roel_bench.runner import Runner

    cells = suites.select(suite, scenes, methods)
    results = Runner(places=Places(data=data, rooms=rooms), folder=out, progress=progress).run(
        cells
    )
    text = tables.all_rows(results)
    tables.write_text(out / "mapping.md", text)
    return to_document(results), text


def bench_registration(
    path: Path,
    *,
    rooms: list[tuple[str, str]],
    has_large: bool,
    symmetric_count: int,
    scans: Path | None,
    max_count: int | None,
    progress: ProgressCallback,
) -> tuple[dict[str, Any], str]:
    """Run what the file does not hold of the registration benchmark; its trials, and their page.

    Args:
        path: JSON file, which an interrupted run goes on with.
        rooms: pairs of map and cloud, or of two maps.
        has_large: whether all rooms side by side are a place as well.
        symmetric_count: rooms of boxes to make.
        scans: folder of real scans.
        max_count: trials of each kind at the most.
    """
    from dataclasses import replace

    from roel_bench import (
        registration,
        registration_places,
        registration_report,
        registration_scans,
    )

    places = [
        registration_places.place_of(
            Path(map_name).stem, _read_map(map_name), Path(target).stem, _read_target(target)
        )
        for map_name, target in rooms
    ]
    if has_large:
        places.append(registration_places.side_by_side(places))
    places += registration_places.symmetric_rooms(symmetric_count)
    protocols = [
        replace(protocol, count=min(protocol.count, max_count or protocol.count))
        for protocol in registration.PROTOCOLS
    ]
    if scans is not None:
        registration.keep(registration_scans.run(scans), path)
    document = registration.run(places, protocols, progress, path=path)
    return document, registration_report.document(document)


def bench_poses(
    path: Path,
    *,
    rooms: tuple[str, ...],
    seed_count: int,
    data: Path | None,
    kept: Path,
    progress: ProgressCallback,
) -> tuple[dict[str, Any], str]:
    """Run what the file does not hold of the benchmark of poses; all rows, and their page."""
    from roel_bench import poses, poses_report
    from roel_bench.catalogue import Places

    results = poses.run(path, rooms, seed_count, Places(data=data, rooms=kept), progress)
    return asdict(results), poses_report.document(results)


def bench_localization(
    path: Path,
    *,
    rooms: list[tuple[str, str]],
    house: tuple[str, str] | None,
    symmetric_count: int,
    protocols: list[str],
    methods: list[str],
    max_count: int | None,
    again: bool,
    progress: ProgressCallback,
) -> tuple[dict[str, Any], str]:
    """Run what the file does not hold of the localization benchmark; the file, and its tables.

    Args:
        path: JSON file, which an interrupted run goes on with.
        rooms: pairs of map and folder of panoramas.
        house: archive of lines with rooms, and folder of photographs.
        symmetric_count: rooms of boxes to make.
        protocols, methods: names; all without any.
        max_count: panoramas of a place at the most.
        again: run what the file holds, too.
    """
    from dataclasses import replace

    from roel_bench import localization, localization_places, localization_report

    places = [
        localization_places.room(Path(name).stem, _read_map(name), Path(folder))
        for name, folder in rooms
    ]
    if house is not None:
        places += localization_places.house(Path(house[0]), Path(house[1]))
    places += localization_places.symmetric_rooms(symmetric_count)
    chosen = [
        replace(protocol, max_count=min(protocol.max_count, max_count or protocol.max_count))
        for protocol in localization.PROTOCOLS
        if not protocols or protocol.name in protocols
    ]
    results = localization.run(
        places, chosen, localization.find_methods(methods), path, progress, again=again
    )
    return localization.to_document(results), localization_report.measured(results)
