"""Panoramas are located in maps, here or on a server."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from roel_client.local.maps import hosted, read_map
from roel_service.naming import naming

if TYPE_CHECKING:
    from roel_client.client import Client
    from roel_service.arrays import Array
    from roel_service.config.stages import LocalizeConfig
    from roel_service.geometry.se3 import SE3
    from roel_service.scene.camera import Camera
    from roel_service.scene.lines import LineMap
    from roel_service.scene.results import PanoLocResult
    from roel_service.v1.types_pb2 import BlobRef

# A message has 4 MiB.
MAX_INLINE_BYTES = 3_500_000


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

    line_maps = [read_map(name) for name in names]
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
        from roel_service.pano_loc.warm import warm_up

        warm_up()
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
        line_maps = [read_map(name) for name in names]
        overlay.mkdir()
    with Client(server, **options) as client, ExitStack() as hosting:
        versions = [hosting.enter_context(hosted(client, name)) for name in names]
        for index, panorama_name in enumerate(panorama_names):
            with naming({"image": panorama_name}):
                image = _sent_image(client, Path(panorama_name))
                message = client.localize(versions, image, T_prior=T_prior, config=config)
            result = localization_from_proto(message)
            if overlay is not None:
                _draw_overlay(overlay, index, panorama_name, line_maps, result)
            yield _localization_document(panorama_name, names, result, message.seconds)


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
