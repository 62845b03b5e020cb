"""A map is laid over a cloud or another map, here or on a server."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from roel_client.local.maps import hosted, is_map_file, read_map, read_map_file
from roel_service.naming import naming
from roel_service.wire.names import is_resource_name

if TYPE_CHECKING:
    from roel_client.client import Client
    from roel_service.config.stages import RegisterConfig
    from roel_service.scene.clouds import PointCloud
    from roel_service.scene.lines import LineMap
    from roel_service.scene.results import RegistrationResult
    from roel_service.v1.types_pb2 import BlobRef


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
    line_map = read_map(name)
    cloud = read_target(cloud_name)
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
        hosted(client, name) as version,
        _hosted_target(client, cloud_name) as target,
        naming({version: name}),
    ):
        message = client.register(version, target, T_init=T_init, method=method, config=config)
    result = registration_from_proto(message)
    if plot is not None:
        start = SE3.identity() if T_init is None else T_init
        draw_registration(read_map(name), read_target(cloud_name), start, result, plot)
    return _registration_document(result, message.seconds)


@contextmanager
def _hosted_target(client: Client, name: str) -> Iterator[str | BlobRef]:
    """The same for what a map is registered with, which may be a cloud."""
    if is_resource_name(name) or is_map_file(name):
        with hosted(client, name) as version:
            yield version
    else:
        yield client.upload_blob(Path(name))


def read_target(name: str) -> PointCloud | LineMap:
    """What a map is registered with: a `.rlm` file, or a cloud of any format."""
    from roel_service.io.clouds import read_cloud

    return read_map_file(name).line_map if is_map_file(name) else read_cloud(Path(name))


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
