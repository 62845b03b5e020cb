"""Line maps from other programs, and exports of ours read back; formats are told by content."""

from __future__ import annotations

import io
import json
import re
import zipfile
import zlib
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np

from roel_service.arrays import Array, FloatArray
from roel_service.errors import MapFileError
from roel_service.io.files import open_input
from roel_service.io.maps import FIELDS, line_map_from_fields
from roel_service.io.npz import read_npz
from roel_service.io.ply import read_ply_edges
from roel_service.scene.lines import LineMap

FOREIGN_FORMATS = ("npz", "json", "csv", "obj", "ply", "dxf", "limap")

# Enough to tell every format.
_HEAD_BYTES = 4096

_ENDS = ("x0", "y0", "z0", "x1", "y1", "z1")
_DXF = re.compile(rb"\s*(?:999\r?\n.*\r?\n\s*)*0\r?\n\s*SECTION\b")
_OBJ = re.compile(rb"^v[ \t]", re.MULTILINE)
_COUNT = re.compile(rb"\s*\d+\s*\n")
_LIMAP_TRACK = re.compile(r"(?:.*/)?track_(\d+)\.txt")
_LIMAP_TRACKS = re.compile(r"(?:.*/)?alltracks\.txt")
# The ends of a line and its counts stand in the first two lines of its file.
_TRACK_HEAD_BYTES = 1024
_MAX_DEFLATE_RATIO = 1032

# What damage raises, depending on the format and the place.
_DAMAGE = (
    ValueError, KeyError, TypeError, IndexError, OverflowError, EOFError, RecursionError,
    zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError,
)  # fmt: skip


def read_foreign_map(path: Path, subject: str) -> tuple[str, LineMap]:
    """Format and lines of a file; m, in the order of the file.

    Args:
        path: the file; its name does not matter.
        subject: what errors call it.

    Raises:
        MapFileError: a format that is not one of `FOREIGN_FORMATS`, or damage.
    """
    name = _told_format(path, subject)
    try:
        return name, _READERS[name](path, subject)
    except _DAMAGE as damage:
        found = str(damage) or type(damage).__name__
        if isinstance(damage, KeyError):
            found = f"no {damage.args[0]}"
        raise MapFileError(subject, f"lines in the format {name}", found) from damage


def _told_format(path: Path, subject: str) -> str:
    with open_input(path) as file:
        head = file.read(_HEAD_BYTES)
    text = head.lstrip()
    if head.startswith(b"PK"):
        return _told_archive(path)
    if head.startswith(b"ply"):
        return "ply"
    if text.startswith(b"["):
        return "json"
    if _DXF.match(head):
        return "dxf"
    if _ENDS[0].encode() in text.partition(b"\n")[0].split(b","):
        return "csv"
    if _COUNT.match(head):
        return "limap"
    if _OBJ.search(head):
        return "obj"
    expected = f"a map file, or lines as one of {', '.join(FOREIGN_FORMATS)}"
    raise MapFileError(subject, expected, f"{bytes(head[:16])!r}")


def _told_archive(path: Path) -> str:
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except _DAMAGE:
        return "npz"
    of_limap = (_LIMAP_TRACK, _LIMAP_TRACKS)
    is_limap = any(pattern.fullmatch(name) for name in names for pattern in of_limap)
    return "limap" if is_limap else "npz"


def _read_npz(path: Path, subject: str) -> LineMap:
    return line_map_from_fields(read_npz(path, FIELDS, subject, MapFileError))


def _read_ply(path: Path, subject: str) -> LineMap:
    segments, columns = read_ply_edges(path, MapFileError, subject)
    known = {name: columns[name] for name in FIELDS[1:] if name in columns}
    return line_map_from_fields({"segments": segments, **known})


def _read_json(path: Path, subject: str) -> LineMap:
    """One array with a record for each line; records agree in their keys."""
    records = json.loads(path.read_bytes())
    if not isinstance(records, list) or not all(isinstance(item, dict) for item in records):
        raise ValueError("no array of records")
    present = [name for name in FIELDS if records and name in records[0]]
    return line_map_from_fields(
        {name: np.array([record[name] for record in records]) for name in present}
    )


def _read_csv(path: Path, subject: str) -> LineMap:
    header, _, body = path.read_bytes().partition(b"\n")
    names = [name.strip() for name in header.decode("ascii").split(",")]
    rows = np.empty((0, len(names)))
    if body.strip():
        rows = np.loadtxt(io.BytesIO(body), delimiter=",", ndmin=2)
    columns = dict(zip(names, rows.T, strict=True))
    fields: dict[str, Array] = {
        "segments": np.stack([columns[name] for name in _ENDS], axis=1).reshape(-1, 2, 3)
    }
    fields |= {name: columns[name] for name in FIELDS[1:] if name in columns}
    return line_map_from_fields(fields)


def _read_obj(path: Path, subject: str) -> LineMap:
    """`v` and `l`; a polyline is one line for each of its pieces."""
    vertices: list[tuple[float, ...]] = []
    ends: list[tuple[int, int]] = []
    with path.open("rb") as file:
        for line in file:
            match line.split():
                case [b"v", x, y, z, *_]:
                    vertices.append((float(x), float(y), float(z)))
                case [b"l", *corners]:
                    ends += pairwise(_obj_index(corner, len(vertices)) for corner in corners)
    rows = np.array(ends, np.int64).reshape(-1, 2)
    return LineMap.from_segments(np.array(vertices).reshape(-1, 3)[rows])


def _obj_index(corner: bytes, vertex_count: int) -> int:
    """Index from 0 of a corner such as `7`, `7/1` or, counted from the end, `-1`."""
    number = int(corner.partition(b"/")[0])
    index = number - 1 if number > 0 else vertex_count + number
    if number == 0 or not 0 <= index < vertex_count:
        raise ValueError(f"vertex {number} of {vertex_count}")
    return index


def _read_dxf(path: Path, subject: str) -> LineMap:
    """Entities LINE of the section ENTITIES; a coordinate that is not said is 0."""
    segments = [
        [[entity.get(code, 0.0) for code in codes] for codes in ((10, 20, 30), (11, 21, 31))]
        for entity in _dxf_lines(path)
    ]
    return LineMap.from_segments(np.array(segments, np.float64).reshape(-1, 2, 3))


def _dxf_lines(path: Path) -> Iterator[dict[int, float]]:
    """Coordinates by group code, one dictionary for each LINE."""
    section, entity, numbers = "", "", dict[int, float]()
    for code, value in _dxf_groups(path):
        if code == 0:
            if (section, entity) == ("ENTITIES", "LINE"):
                yield numbers
            entity, numbers = value, {}
        elif code == 2 and entity == "SECTION":
            section = value
        elif 10 <= code < 40 and entity == "LINE":
            numbers[code] = float(value)


def _dxf_groups(path: Path) -> Iterator[tuple[int, str]]:
    """Pairs of group code and value, each on a line of its own."""
    with path.open(encoding="latin-1") as file:
        for code in file:
            yield int(code), next(file, "").strip()


def _read_limap(path: Path, subject: str) -> LineMap:
    """Tracks in one text, or an archive of such a text or of a text for each track."""
    if not zipfile.is_zipfile(path):
        return _limap_map(_listed_tracks(path.read_bytes()))
    with zipfile.ZipFile(path) as archive:
        for info in archive.infolist():
            if _LIMAP_TRACKS.fullmatch(info.filename):
                if info.file_size > _MAX_DEFLATE_RATIO * info.compress_size:
                    raise ValueError(f"{info.file_size} bytes in {info.compress_size}")
                return _limap_map(_listed_tracks(archive.read(info)))
        tracks = [(match, info) for info in archive.infolist() if (match := _track_name(info))]
        tracks.sort(key=lambda track: track[0])
        return _limap_map([_track(archive, info) for _, info in tracks])


def _track_name(info: zipfile.ZipInfo) -> tuple[int] | None:
    match = _LIMAP_TRACK.fullmatch(info.filename)
    return (int(match[1]),) if match else None


def _track(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> tuple[list[float], int]:
    with archive.open(info) as file:
        fields = file.read(_TRACK_HEAD_BYTES).split()
    return [float(field) for field in fields[:6]], int(fields[7])


def _listed_tracks(data: bytes) -> list[tuple[list[float], int]]:
    """Tracks as `id line_count image_count`, six coordinates, image ids, line ids."""
    fields = data.split()
    tracks = []
    position = 1
    for _ in range(int(fields[0])):
        line_count, image_count = int(fields[position + 1]), int(fields[position + 2])
        if line_count < 0:
            raise ValueError(f"a track of {line_count} lines")
        ends = [float(field) for field in fields[position + 3 : position + 9]]
        tracks.append((ends, image_count))
        position += 9 + 2 * line_count
    if position != len(fields):
        raise ValueError(f"{len(fields)} fields instead of {position}")
    return tracks


def _limap_map(tracks: list[tuple[list[float], int]]) -> LineMap:
    ends = np.array([ends for ends, _ in tracks], np.float64)
    segments: FloatArray = ends.reshape(-1, 2, 3)
    counts = np.array([count for _, count in tracks], np.int64)
    return line_map_from_fields({"segments": segments, "observation_count": counts})


_READERS: dict[str, Callable[[Path, str], LineMap]] = {
    "npz": _read_npz,
    "json": _read_json,
    "csv": _read_csv,
    "obj": _read_obj,
    "ply": _read_ply,
    "dxf": _read_dxf,
    "limap": _read_limap,
}
