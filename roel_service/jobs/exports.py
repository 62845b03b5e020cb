"""A map version as a file of another format; runs in a child, since large maps take long."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from roel_service.io.maps import export_map
from roel_service.jobs.task import Tell
from roel_service.wire.rlm import decode_map


@dataclass(frozen=True, kw_only=True)
class ExportParameters:
    """What to export.

    Attributes:
        map_file: the version's bytes.
        target: a new file; its suffix names the format.
    """

    map_file: Path
    target: Path


def run_export(parameters: ExportParameters, tell: Tell) -> None:
    """Entry point of an export."""
    map_file = decode_map(parameters.map_file.read_bytes(), subject="map version")
    export_map(map_file.line_map, parameters.target)
