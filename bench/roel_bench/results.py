"""Rows of a benchmark and the file that keeps them."""

from __future__ import annotations

import hashlib
import json
import math
import os
import platform
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from importlib import metadata
from pathlib import Path
from typing import Any

from roel_service import __version__
from roel_service.config.load import to_tables
from roel_service.config.stages import AFTER_MAPPING, UNLIMITED, Config
from roel_service.errors import InputError
from roel_service.io.files import read_input, whole_file

Figures = dict[str, float | int | None]

NO_DISTURBANCE = "none"
FILE_NAME = "mapping.json"
FORMAT = "roel mapping benchmark 1"
# Thousands of rows are a few megabytes.
MAX_BYTES = 256 << 20
# What the lines of single frames depend on.
FRONT_END_TABLES = ("frames", "detect", "plane_fit")
PACKAGES = ("numpy", "scipy", "numba", "opencv-contrib-python-headless")


@dataclass(frozen=True, kw_only=True)
class Row:
    """One method on one scene.

    Attributes:
        task: `map`, or `front_end` for the lines of single frames.
        scene, sensor, is_tuning: the scene, its size WxH, and whether it counts in no mean.
        disturbance: what was done to the scene, or `none`.
        method: name of the variant or of the peer.
        config_digest: of every parameter of the method; tells whether the row is still true.
        figures: by name; None where there is no figure, e.g. the accuracy of an empty map.
        seconds: wall-clock time of each stage; other work on the machine lengthens it.
        frame_count, event_count: frames looked at, 0 for a method without frames; events read.
        peak_rss_mib: the largest resident memory while the method ran; None where the system does
            not tell.
        error: why there is no map, and so no figure: the reason and what was found; empty where
            there is one. A map without lines is no error.
        processor_s: processor time of all threads, which a busy machine hardly changes; None where
            it was not measured.
    """

    task: str
    scene: str
    sensor: str
    is_tuning: bool
    disturbance: str
    method: str
    config_digest: str
    figures: Figures
    seconds: dict[str, float]
    frame_count: int
    event_count: int
    peak_rss_mib: float | None
    error: str = ""
    processor_s: float | None = None

    @property
    def key(self) -> tuple[str, ...]:
        """What tells rows apart; a row with other parameters takes the place of the older one."""
        return (self.task, self.scene, self.disturbance, self.method)

    @property
    def ms_per_frame(self) -> float | None:
        """All stages together; None for a method without frames."""
        if self.frame_count == 0:
            return None
        return 1e3 * sum(self.seconds.values()) / self.frame_count

    @property
    def processor_ms_per_frame(self) -> float | None:
        """All stages and threads together; None where it was not measured."""
        if self.frame_count == 0 or self.processor_s is None:
            return None
        return 1e3 * self.processor_s / self.frame_count


@dataclass(frozen=True, kw_only=True)
class Results:
    """All rows of a benchmark on one machine.

    Attributes:
        machine: processor, cores, system and Python.
        versions: of this project and of what it computes with.
        rows: in the order in which they were run.
    """

    machine: dict[str, str | int]
    versions: dict[str, str]
    rows: tuple[Row, ...] = ()

    def with_row(self, row: Row) -> Results:
        """These rows and one more, which takes the place of an older one of its key."""
        others = tuple(other for other in self.rows if other.key != row.key)
        return Results(machine=self.machine, versions=self.versions, rows=(*others, row))

    def select(self, holds: Callable[[Row], bool]) -> list[Row]:
        """The rows for which something holds."""
        return [row for row in self.rows if holds(row)]


def this_machine() -> Results:
    """No rows yet, of the machine that this runs on."""
    return Results(
        machine={
            "processor": _processor(),
            "core_count": os.cpu_count() or 1,
            "system": f"{platform.system()} {platform.machine()}",
            "python": platform.python_version(),
        },
        versions={"roel_service": __version__}
        | {package: metadata.version(package) for package in PACKAGES},
    )


def machine_text(machine: Mapping[str, Any], versions: Mapping[str, str]) -> str:
    """A machine and its packages, as reports tell them."""
    packages = ", ".join(f"{name} {version}" for name, version in versions.items())
    return (
        f"{machine['processor']}, {machine['core_count']} cores, {machine['system']}, Python"
        f" {machine['python']}; {packages}"
    )


def _processor() -> str:
    """The processor's own name where Linux tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or "unknown"


def config_digest(config: Config) -> str:
    """Twelve hexadecimal digits that change with any parameter of mapping.

    What is off leaves no trace: rows from before it was there stay valid.
    """
    tables = to_tables(config)
    for table in ("runtime", *AFTER_MAPPING):
        del tables[table]
    if config.curves.method == "none":
        del tables["curves"]
    _drop_unread_tests(config, tables)
    if config.match_global.method != "reassociate":
        del tables["match_global"]["max_shared_fraction"]
    if config.match_global.method != "reassociate" or not config.match_global.one_side:
        del tables["match_global"]["one_side"]
    if config.trim.method != "coverage":
        del tables["trim"]["max_foreshortening"]
    if config.trim.max_error_m == UNLIMITED:
        del tables["trim"]["max_error_m"]
    is_on = {"pose_": config.refine.free_poses, "corner_": config.refine.corner_sigma_m > 0}
    off = tuple(prefix for prefix in is_on if not is_on[prefix])
    refine = tables["refine"]
    tables["refine"] = {key: refine[key] for key in refine if not key.startswith(off)}
    for table in ("refine_rounds", "refine"):
        if tables[table]["loss_scale_medians"] == 0:
            del tables[table]["loss_scale_medians"]
    return digest_of(json.dumps(tables, sort_keys=True))


def front_end_digest(config: Config) -> str:
    """Twelve hexadecimal digits that change with any parameter of the lines of single frames."""
    tables = to_tables(config)
    _drop_unread_tests(config, tables)
    return digest_of(json.dumps({name: tables[name] for name in FRONT_END_TABLES}, sort_keys=True))


def _drop_unread_tests(config: Config, tables: dict[str, Any]) -> None:
    """Leave out the tests of lines that the plane fit of this method does not make."""
    if config.plane_fit.method != "vote":
        for test in ("min_occupancy", "min_density_ratio"):
            del tables["plane_fit"][test]


def digest_of(text: str) -> str:
    """Twelve hexadecimal digits of a text."""
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def write_results(path: Path, results: Results) -> None:
    """Write all rows, one a line; the file is whole or as it was before."""
    document = to_document(results)
    rows = ",\n".join(_json(row) for row in document.pop("rows"))
    head = _json(document).removesuffix("}")
    with whole_file(path) as temporary:
        temporary.write_text(f'{head}, "rows": [\n{rows}\n]}}\n', encoding="utf-8")


def _json(value: Any) -> str:
    return json.dumps(value, allow_nan=False, ensure_ascii=False)


def to_document(results: Results) -> dict[str, Any]:
    """What JSON can hold of them."""
    return {
        "format": FORMAT,
        "machine": results.machine,
        "versions": results.versions,
        "rows": [_plain(asdict(row)) for row in results.rows],
    }


def read_results(path: Path) -> Results:
    """Read what `write_results` wrote.

    Raises:
        InputError: no readable file, or no results of this format.
    """
    try:
        document = json.loads(read_input(path, MAX_BYTES))
        if document["format"] != FORMAT:
            raise InputError(str(path), FORMAT, repr(document["format"]))
        names = {item.name for item in fields(Row)}
        return Results(
            machine=document["machine"],
            versions=document["versions"],
            rows=tuple(
                Row(**{key: value for key, value in row.items() if key in names})
                for row in document["rows"]
            ),
        )
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(str(path), f"JSON of format {FORMAT!r}", str(error)) from error


def _plain(value: Any) -> Any:
    """JSON has no NaN; digits beyond a millionth are noise that only makes files long."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value
