"""Map files: read, described, converted, lent to a server."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from roel_service.naming import naming
from roel_service.wire.names import is_resource_name

if TYPE_CHECKING:
    from roel_client.client import Client
    from roel_service.scene.lines import LineMap
    from roel_service.wire.rlm import MapFile


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
    from roel_service.jobs.imports import read_lines

    foreign_format, rlm_bytes, map_file = read_lines(Path(name), name)
    path.write_bytes(rlm_bytes)
    return foreign_format, len(map_file.line_map), map_file.dropped_line_count


def read_map(name: str) -> LineMap:
    """Lines of a `.rlm` file or an exported NPZ."""
    from roel_service.io.maps import read_exported_map

    return read_map_file(name).line_map if is_map_file(name) else read_exported_map(Path(name))


def is_map_file(name: str) -> bool:
    """Whether a file begins as a `.rlm` file does."""
    from roel_service.io.files import open_input
    from roel_service.wire.rlm import RLM_MAGIC

    with open_input(Path(name)) as file:
        return file.read(len(RLM_MAGIC)) == RLM_MAGIC


@contextmanager
def hosted(client: Client, name: str) -> Iterator[str]:
    """Name of a version on the server: one that is there, or a file's for a while."""
    if is_resource_name(name):
        yield name
        return
    with naming({"imported file": name}), client.hosted_map(Path(name)) as version:
        yield version


def digest_of(name: str) -> str:
    """Hexadecimal digest of a map file; raises `MapFileError` for any other file."""
    return read_map_file(name).digest.removeprefix("sha256:")
