"""A file of lines as a map version; runs in a child, since the file may be hostile."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

from roel_service.errors import MapFileError
from roel_service.io.foreign_maps import read_foreign_map
from roel_service.jobs.task import Tell
from roel_service.progress import Progress
from roel_service.store.builds import BuiltVersion
from roel_service.wire.provenance import Provenance
from roel_service.wire.rlm import RLM_MAGIC, decode_map, encode_map

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
    name, rlm_bytes = _rlm_bytes(parameters.file)
    map_file = decode_map(rlm_bytes, subject=SUBJECT)
    if len(map_file.line_map) == 0:
        raise MapFileError(SUBJECT, "lines", "none")
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


def _rlm_bytes(file: Path) -> tuple[str, bytes]:
    """Format of a file, and its lines as a map file; one that is a map file stays as it is."""
    with file.open("rb") as opened:
        is_map_file = opened.read(len(RLM_MAGIC)) == RLM_MAGIC
    if is_map_file:
        return "rlm", file.read_bytes()
    name, line_map = read_foreign_map(file, SUBJECT)
    return name, encode_map(line_map, Provenance())
