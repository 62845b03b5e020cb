"""A file of lines as a map version; runs in a child, since the file may be hostile."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

from roel_service.errors import MapFileError
from roel_service.io.files import open_input
from roel_service.io.foreign_maps import read_foreign_map
from roel_service.jobs.task import Tell
from roel_service.progress import Progress
from roel_service.store.builds import BuiltVersion
from roel_service.wire.provenance import Provenance
from roel_service.wire.rlm import RLM_MAGIC, MapFile, decode_map, encode_map

STAGE = "import"

# What errors call the file, whose name in the store tells nobody anything.
SUBJECT = "imported file"


@dataclass(frozen=True, kw_only=True)
class ImportParameters:
    """What to import.

    Attributes:
        file: the bytes that were sent.
        sha256: their hexadecimal digest.
    """

    file: Path
    sha256: str


def run_import(parameters: ImportParameters, tell: Tell) -> BuiltVersion:
    """Entry point of an import.

    Raises:
        MapFileError: a file that is damaged, of an unknown format, or without lines.
    """
    tell(Progress(stage=STAGE, done_count=0, total_count=1, fraction=0.0))
    name, rlm_bytes, map_file = read_lines(parameters.file, SUBJECT)
    return BuiltVersion(
        rlm_bytes=rlm_bytes,
        line_count=len(map_file.line_map),
        bounds_m=map_file.line_map.bounds_m.ravel().tolist(),
        report={},
        provenance=asdict(map_file.provenance),
        imported_file={
            "sha256": parameters.sha256,
            "size_bytes": parameters.file.stat().st_size,
            "format": name,
            "dropped_line_count": 0 if name == "rlm" else map_file.dropped_line_count,
        },
    )


def read_lines(file: Path, subject: str) -> tuple[str, bytes, MapFile]:
    """Format of a file, its lines as the bytes of a map file, and what these hold.

    Args:
        subject: what errors call the file.

    Raises:
        InputError: no readable file.
        MapFileError: a file that is damaged, of an unknown format, or without lines.
    """
    name, rlm_bytes = _rlm_bytes(file, subject)
    map_file = decode_map(rlm_bytes, subject=subject)
    if len(map_file.line_map) == 0:
        raise MapFileError(subject, "lines", "none")
    return name, rlm_bytes, map_file


def _rlm_bytes(file: Path, subject: str) -> tuple[str, bytes]:
    """Format of a file, and its lines as a map file; one that is a map file stays as it is."""
    with open_input(file) as opened:
        is_map_file = opened.read(len(RLM_MAGIC)) == RLM_MAGIC
    if is_map_file:
        return "rlm", file.read_bytes()
    name, line_map = read_foreign_map(file, subject)
    return name, encode_map(line_map, Provenance())
