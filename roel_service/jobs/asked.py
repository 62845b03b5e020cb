"""Questions made of requests: the names in them looked up, and their fields checked."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from roel_service.arrays import FloatArray
from roel_service.config.stages import LocalizeConfig, RegisterConfig
from roel_service.errors import ConfigError, InputError, LimitError
from roel_service.jobs.cache_place import CachePlace
from roel_service.jobs.questions import (
    LocalizeQuestion,
    MapFile,
    RegisterQuestion,
    StoredFile,
    TrackingBegins,
)
from roel_service.pano_loc.hints import MAX_MAP_COUNT, Gravity, PosePrior
from roel_service.register.vertical import Vertical
from roel_service.scene.camera import Camera
from roel_service.store.maps import Maps
from roel_service.store.store import maps_of
from roel_service.v1 import config_pb2, localization_pb2, registration_pb2, types_pb2
from roel_service.wire import names
from roel_service.wire.configs import config_from_proto
from roel_service.wire.nouns import camera_from_proto, transform_from_proto, vector_from_proto
from roel_service.wire.registration import METHODS

DEFAULT_PRESET = "default"
BYTES_PER_POINT = 12
MAX_HYPOTHESIS_COUNT = 5
MAX_UP_SIGMA_DEG = 90.0
UNIT_TOLERANCE = 1e-3


class Questions:
    """Makes questions of requests.

    Args:
        maps: where versions are looked up.
        blob_path: where an uploaded blob lies; raises `NotFoundError`.
        cache: where prepared inputs are kept.
        inline_point_count: most points of a cloud in a request.
    """

    def __init__(
        self,
        maps: Maps,
        blob_path: Callable[[str], Path],
        cache: CachePlace | None,
        inline_point_count: int,
    ) -> None:
        self._maps = maps
        self._blob_path = blob_path
        self._cache = cache
        self._inline_point_count = inline_point_count

    def registration(self, request: registration_pb2.RegisterRequest) -> RegisterQuestion:
        """A request of Register.

        Raises:
            InputError: a field that cannot be used.
            ConfigError: an unknown preset, or a value out of range.
            LimitError: too many points.
            NotFoundError, StateError: a version or blob that is not there, or not usable.
        """
        method = _method(request)
        return RegisterQuestion(
            source=self._map_file(request.map_version),
            target=self._target(request),
            T_init=transform_from_proto(request.init, "init") if request.HasField("init") else None,
            method=method,
            vertical=_vertical(request),
            config=_register_config(request),
            cache=self._cache,
        )

    def localization(self, request: localization_pb2.LocalizeRequest) -> LocalizeQuestion:
        """A request of Localize; raises as `registration`."""
        return dataclasses.replace(self.search(request), image=self._image(request))

    def search(self, request: localization_pb2.LocalizeRequest) -> LocalizeQuestion:
        """Where and how to look, for any picture; raises as `registration`."""
        if request.preset not in ("", DEFAULT_PRESET):
            # The others are other methods, anchors of the benchmark.
            raise ConfigError("preset", DEFAULT_PRESET, request.preset)
        tables = config_pb2.MappingConfig(localize=request.config)
        config = config_from_proto(tables).localize
        return LocalizeQuestion(
            maps=self._map_files(request.map_versions),
            image=b"",
            prior=pose_prior(request.prior) if request.HasField("prior") else None,
            camera=_camera(request),
            gravity=_gravity(request),
            max_hypothesis_count=_hypothesis_count(request, config),
            config=config,
            cache=self._cache,
        )

    def tracking(self, setup: localization_pb2.TrackingSetup) -> TrackingBegins:
        """The first message of TrackPoses; raises as `registration`."""
        tables = config_pb2.MappingConfig(track=setup.config)
        return TrackingBegins(
            map=self._map_file(setup.map_version),
            camera=camera_from_proto(setup.camera),
            T_world_camera=transform_from_proto(setup.T_world_camera, "T_world_camera"),
            t_us=setup.t_us,
            config=config_from_proto(tables, setup.preset or DEFAULT_PRESET).track,
        )

    def _map_files(self, map_versions: Sequence[str]) -> tuple[MapFile, ...]:
        if not 1 <= len(map_versions) <= MAX_MAP_COUNT:
            expected = f"1 to {MAX_MAP_COUNT} versions"
            raise InputError("map_versions", expected, f"{len(map_versions)}")
        files = {file.name: file for file in map(self._map_file, map_versions)}
        return tuple(files.values())

    def _image(self, request: localization_pb2.LocalizeRequest) -> StoredFile | bytes:
        kind = request.WhichOneof("picture")
        if kind is None:
            raise InputError("picture", "image or image_blob", "none")
        return request.image if kind == "image" else self._blob(request.image_blob, "image")

    def _target(self, request: registration_pb2.RegisterRequest) -> MapFile | StoredFile | bytes:
        kind = request.WhichOneof("target")
        if kind == "points":
            return self._points(request.points)
        if kind == "cloud":
            return self._blob(request.cloud, "cloud")
        if kind == "target_map_version":
            return self._map_file(request.target_map_version)
        raise InputError("target", "points, cloud or target_map_version", "none")

    def _points(self, message: types_pb2.Points) -> bytes:
        count, rest = divmod(len(message.points_m), BYTES_PER_POINT)
        if rest:
            found = f"{len(message.points_m)} bytes"
            raise InputError("points", f"rows of {BYTES_PER_POINT} bytes", found)
        if count > self._inline_point_count:
            expected = f"at most {self._inline_point_count} points (upload more as a blob)"
            raise LimitError("points", expected, f"{count}")
        return bytes(message.points_m)

    def _map_file(self, name: str) -> MapFile:
        record = self._maps.version(*names.map_version_id(name))
        path = self._maps.map_path(record)
        found = names.map_version_name(record.map_id, record.version)
        return MapFile(name=found, path=path, sha256=record.sha256)

    def _blob(self, message: types_pb2.BlobRef, name: str) -> StoredFile:
        sha256 = names.checked_sha256(message.sha256)
        return StoredFile(name=name, path=self._blob_path(sha256), sha256=sha256)


@contextmanager
def questions_of(
    folder: Path, cache: CachePlace | None, inline_point_count: int
) -> Iterator[Questions]:
    """Makes questions beside the server that has the folder; arguments as of `Questions`."""
    with maps_of(folder) as (maps, blobs):

        def blob_path(sha256: str) -> Path:
            blobs.require(sha256)
            return blobs.path(sha256)

        yield Questions(maps, blob_path, cache, inline_point_count)


def _method(request: registration_pb2.RegisterRequest) -> str:
    if not 0 <= request.method < len(METHODS):
        expected = f"one of {', '.join(dict.fromkeys(METHODS))}"
        raise InputError("method", expected, f"{request.method}")
    method = METHODS[request.method]
    if method == "global" and request.HasField("init"):
        raise InputError("init", "no first guess with method GLOBAL", "one")
    return method


def _register_config(request: registration_pb2.RegisterRequest) -> RegisterConfig:
    tables = config_pb2.MappingConfig(register=request.config)
    config = config_from_proto(tables, request.preset or DEFAULT_PRESET).register
    if not request.estimate_scale:
        return config
    return dataclasses.replace(config, estimate_scale=True)


def pose_prior(message: types_pb2.Transform) -> PosePrior:
    """About where a picture was taken; raises `InputError`."""
    return PosePrior(T_world_picture=transform_from_proto(message, "prior"))


def _camera(request: localization_pb2.LocalizeRequest) -> Camera | None:
    if not request.HasField("camera"):
        return None
    if not request.HasField("prior"):
        raise InputError("prior", "a first pose, as there is a camera", "none")
    return camera_from_proto(request.camera)


def _vertical(request: registration_pb2.RegisterRequest) -> Vertical | None:
    ups = _ups(request, "up_source", "up_target")
    return None if ups is None else Vertical(up_source=ups[0], up_target=ups[1])


def _gravity(request: localization_pb2.LocalizeRequest) -> Gravity | None:
    ups = _ups(request, "up_world", "up_panorama")
    if ups is None:
        return None
    up_world, up_picture = ups
    if not 0.0 <= request.up_sigma_deg <= MAX_UP_SIGMA_DEG:
        expected = f"0 to {MAX_UP_SIGMA_DEG:.0f} degrees"
        raise InputError("up_sigma_deg", expected, f"{request.up_sigma_deg}")
    if request.up_sigma_deg == 0.0:
        return Gravity(up_world=up_world, up_picture=up_picture)
    sigma_rad = math.radians(request.up_sigma_deg)
    return Gravity(up_world=up_world, up_picture=up_picture, sigma_rad=sigma_rad)


def _ups(
    request: registration_pb2.RegisterRequest | localization_pb2.LocalizeRequest, *names: str
) -> list[FloatArray] | None:
    """Directions against gravity, all of them or none."""
    given = [name for name in names if request.HasField(name)]
    if not given:
        return None
    if len(given) < len(names):
        raise InputError(names[0], f"{' and '.join(names)} together", f"{given[0]} alone")
    return [_direction(getattr(request, name), name) for name in names]


def _direction(message: types_pb2.Vector3, name: str) -> FloatArray:
    """(3,) of a length that is about 1."""
    direction = vector_from_proto(message)
    length = math.hypot(*direction)
    # Comparing like this refuses NaN.
    if not abs(length - 1.0) <= UNIT_TOLERANCE:
        raise InputError(name, "a unit vector", f"one of length {length:g}")
    return direction


def _hypothesis_count(request: localization_pb2.LocalizeRequest, config: LocalizeConfig) -> int:
    if not 0 <= request.max_hypothesis_count <= MAX_HYPOTHESIS_COUNT:
        expected = f"0 to {MAX_HYPOTHESIS_COUNT}"
        raise InputError("max_hypothesis_count", expected, f"{request.max_hypothesis_count}")
    return request.max_hypothesis_count or config.max_hypothesis_count
