"""Line maps for other programs: NPZ, PLY, OBJ, JSON, CSV, DXF. Line order is the same in all."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from roel_service.arrays import Array
from roel_service.errors import InputError, MapFileError
from roel_service.io.files import whole_file
from roel_service.io.npz import read_npz, write_npz
from roel_service.scene.lines import LineMap

EXPORT_FORMATS = ("npz", "ply", "obj", "json", "csv", "dxf")

FIELDS = ("segments", "observation_count", "rms_residual", "sigma_m")


def export_map(line_map: LineMap, path: Path) -> None:
    """Write a map in the format that the suffix names; m, world frame.

    Raises:
        InputError: an unknown suffix, or nothing can be written there.
    """
    suffix = path.suffix.lower()
    if suffix == ".npz":
        write_npz(path, **_fields(line_map))
        return
    if suffix not in _TEXT_FORMATS:
        known = ", ".join(sorted([".npz", *_TEXT_FORMATS]))
        raise InputError(str(path), f"a name ending in one of {known}", f"{suffix!r}")
    with whole_file(path) as temporary, temporary.open("w", encoding="ascii") as file:
        file.writelines(f"{line}\n" for line in _TEXT_FORMATS[suffix](line_map))


def read_exported_map(path: Path) -> LineMap:
    """Read a map back from the NPZ that `export_map` writes; `sigma_m` may be missing.

    Raises:
        InputError: no readable file.
        MapFileError: no NPZ archive with these arrays.
    """
    subject = str(path)
    arrays = read_npz(path, FIELDS, subject, MapFileError)
    for name in FIELDS[:3]:
        if name not in arrays:
            raise MapFileError(subject, f"arrays {', '.join(FIELDS[:3])}", f"no {name}")
    try:
        return line_map_from_fields(arrays)
    except ValueError as error:
        raise MapFileError(subject, "an exported line map", str(error)) from error


def line_map_from_fields(fields: dict[str, Array]) -> LineMap:
    """A map from arrays named as in `FIELDS`; all but the segments may be missing.

    Raises:
        KeyError, ValueError: no segments, or arrays that are no line map.
    """
    segments = fields["segments"]
    count = len(segments) if segments.ndim else 0
    unknown = np.zeros(count, np.int32)
    return LineMap(
        segments=_array(segments, np.float64, "segments"),
        observation_count=_array(
            fields.get("observation_count", unknown), np.int32, "observation_count"
        ),
        rms_residual_px=_array(fields.get("rms_residual", unknown), np.float32, "rms_residual"),
        sigma_m=_array(fields.get("sigma_m", unknown), np.float32, "sigma_m"),
    )


def _array(values: Array, dtype: type[np.generic], name: str) -> Array:
    """As one dtype, provided that it holds every value."""
    if values.dtype.kind not in "iuf":
        raise ValueError(f"{name} of {values.dtype}")
    if dtype is np.int32 and values.size:
        if values.dtype.kind == "f" and (values != np.rint(values)).any():
            raise ValueError(f"{name} of fractions")
        if not 0 <= values.min() <= values.max() < 2**31:
            raise ValueError(f"{name} outside 0 to 2^31")
    with np.errstate(over="ignore"):
        return values.astype(dtype)


def _fields(line_map: LineMap) -> dict[str, Array]:
    columns = (
        line_map.segments,
        line_map.observation_count,
        line_map.rms_residual_px,
        line_map.sigma_m,
    )
    return dict(zip(FIELDS, columns, strict=True))


def _records(line_map: LineMap) -> Iterator[tuple[list[list[float]], int, float, float]]:
    """Segment, observation count, rms residual and sigma of each line as plain numbers."""
    columns = _fields(line_map).values()
    return zip(*(column.tolist() for column in columns), strict=True)


def _json(line_map: LineMap) -> Iterator[str]:
    """One array with a record a segment, each on a line of its own."""
    yield "["
    for index, record in enumerate(_records(line_map), 1):
        comma = "," if index < len(line_map) else ""
        yield json.dumps(dict(zip(FIELDS, record, strict=True))) + comma
    yield "]"


def _csv(line_map: LineMap) -> Iterator[str]:
    yield ",".join(["x0", "y0", "z0", "x1", "y1", "z1", *FIELDS[1:]])
    for (start, end), *rest in _records(line_map):
        yield ",".join(repr(value) for value in (*start, *end, *rest))


def _ply(line_map: LineMap) -> Iterator[str]:
    yield "ply"
    yield "format ascii 1.0"
    yield f"element vertex {2 * len(line_map)}"
    yield from (f"property double {axis}" for axis in "xyz")
    yield f"element edge {len(line_map)}"
    yield from ("property int vertex1", "property int vertex2")
    yield from ("property int observation_count", "property float rms_residual")
    yield "property float sigma_m"
    yield "end_header"
    yield from (_spaced(point) for point in line_map.segments.reshape(-1, 3).tolist())
    for index, (_, *rest) in enumerate(_records(line_map)):
        yield _spaced([2 * index, 2 * index + 1, *rest])


def _obj(line_map: LineMap) -> Iterator[str]:
    yield from (f"v {_spaced(point)}" for point in line_map.segments.reshape(-1, 3).tolist())
    yield from (f"l {2 * index + 1} {2 * index + 2}" for index in range(len(line_map)))


def _dxf(line_map: LineMap) -> Iterator[str]:
    """Release 12, the dialect that every CAD program reads: pairs of group code and value."""
    yield from ("0", "SECTION", "2", "ENTITIES")
    for start, end in line_map.segments.tolist():
        yield from ("0", "LINE", "8", "lines")
        for code, value in zip((10, 20, 30, 11, 21, 31), (*start, *end), strict=True):
            yield from (str(code), repr(value))
    yield from ("0", "ENDSEC", "0", "EOF")


def _spaced(values: list[float]) -> str:
    return " ".join(repr(value) for value in values)


_TEXT_FORMATS: dict[str, Callable[[LineMap], Iterator[str]]] = {
    ".ply": _ply,
    ".obj": _obj,
    ".json": _json,
    ".csv": _csv,
    ".dxf": _dxf,
}
