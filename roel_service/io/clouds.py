"""Meshes and points, told apart by content.

Meshes and edges of the truth are NPZ or PLY. A cloud to register with is also PCD, LAS, LAZ, legacy VTK,
text, or a mesh of any kind that trimesh reads, which is then sampled.
"""

from __future__ import annotations

import io
import logging
import re
import struct
from pathlib import Path

import numpy as np

from roel_service.arrays import Array
from roel_service.errors import CloudError, InputError, MeshError
from roel_service.io.files import open_input
from roel_service.io.las import is_las, read_las
from roel_service.io.npz import read_npz, write_npz
from roel_service.io.pcd import read_pcd
from roel_service.io.ply import read_ply
from roel_service.io.vtk import is_vtk, read_vtk
from roel_service.scene.clouds import PointCloud, TriangleMesh

__all__ = ["read_cloud", "read_mesh", "read_points", "write_npz"]

_log = logging.getLogger(__name__)

# Fewer points than this are no place.
MIN_CLOUD_COUNT = 100
# Meshes are sampled with this many points; a room of 100 square metres then has one in each square of 14 mm.
MESH_SAMPLE_COUNT = 500_000
# Beyond, float32 does not hold single millimetres; national grids are there.
MAX_REACH_M = 20_000.0
# Bytes that tell a format.
HEAD_BYTES = 4096


def read_mesh(path: Path) -> TriangleMesh:
    """Read triangles: NPZ with `triangles` (N, 3, 3), or PLY with faces; m.

    Raises:
        InputError: no readable file.
        MeshError: neither format, no triangles, or a corner that is not finite.
    """
    subject = str(path)
    if _is_ply(path):
        ply = read_ply(path, MeshError)
        if ply.faces is None:
            raise MeshError(subject, "faces", "none")
        triangles = _float32(ply.vertices)[ply.faces]
    else:
        triangles = _npz_array(path, "triangles", (3, 3), MeshError)
    if len(triangles) == 0:
        raise MeshError(subject, "at least one triangle", "none")
    if not np.isfinite(triangles).all():
        raise MeshError(subject, "finite corners", "NaN or infinity")
    return TriangleMesh(triangles=triangles)


def read_cloud(path: Path) -> PointCloud:
    """Read a cloud: PLY, PCD, LAS, LAZ, VTK, NPZ, text `x y z ...`, or a mesh, which is sampled.

    Raises:
        InputError: no readable file.
        CloudError: none of these formats, fewer than `MIN_CLOUD_COUNT` finite points, or points
            too far from the origin for float32.
    """
    return _within_reach(_cloud_of_any_format(path), str(path))


def cloud_of_points(points: Array, subject: str) -> PointCloud:
    """A cloud of (N, 3) points, m; raises `CloudError` as `read_cloud`."""
    return _within_reach(_cloud(points, None, MIN_CLOUD_COUNT, subject), subject)


def _within_reach(cloud: PointCloud, subject: str) -> PointCloud:
    reach_m = float(np.abs(cloud.points).max())
    if reach_m > MAX_REACH_M:
        expected = f"points within {MAX_REACH_M:.0f} m of the origin (move the frame there)"
        found = f"{reach_m:.0f} m; {reach_m / 1000:.0f} m if these are millimetres"
        raise CloudError(subject, expected, found)
    return cloud


def _cloud_of_any_format(path: Path) -> PointCloud:
    subject = str(path)
    with open_input(path) as file:
        head = file.read(HEAD_BYTES)
    if head.startswith(b"ply"):
        ply = read_ply(path, CloudError)
        if ply.faces is not None and len(ply.faces):
            return _sampled(_float32(ply.vertices)[ply.faces], subject)
        return _cloud(ply.vertices, ply.normals, MIN_CLOUD_COUNT, subject)
    if head.startswith(b"PK"):
        return read_points(path, "points", MIN_CLOUD_COUNT)
    if _PCD.match(head):
        return _cloud(*read_pcd(path), MIN_CLOUD_COUNT, subject)
    if is_las(head):
        return _cloud(read_las(path), None, MIN_CLOUD_COUNT, subject)
    if is_vtk(head):
        return _cloud(read_vtk(path), None, MIN_CLOUD_COUNT, subject)
    kind = _mesh_kind(head, path.stat().st_size)
    if kind is not None:
        return _sampled(_trimesh_triangles(path, kind), subject)
    return _cloud(_text_points(path), None, MIN_CLOUD_COUNT, subject)


_PCD = re.compile(rb"(#[^\n]*\n)*\s*(VERSION|FIELDS)\s|# \.PCD")
_OBJ = re.compile(rb"(\s*(#|mtllib |o |g |usemtl |s )[^\n]*\n)*\s*v\s")
_STL_HEADER_BYTES, _STL_TRIANGLE_BYTES = 84, 50


def _mesh_kind(head: bytes, size: int) -> str | None:
    """The format of a mesh, as trimesh calls it."""
    if head.startswith(b"glTF"):
        return "glb"
    if head.startswith(b"OFF"):
        return "off"
    if _OBJ.match(head):
        return "obj"
    triangles = int.from_bytes(head[80:_STL_HEADER_BYTES], "little")
    is_binary = size == _STL_HEADER_BYTES + _STL_TRIANGLE_BYTES * triangles
    return "stl" if is_binary else "stl_ascii" if head.lstrip().startswith(b"solid") else None


def _trimesh_triangles(path: Path, kind: str) -> Array:
    """(N, 3, 3) triangles of a mesh file."""
    import trimesh

    with open_input(path) as file:
        try:
            mesh = trimesh.load_mesh(file, file_type=kind)
        except _TRIMESH_DAMAGE as damage:
            raise CloudError(str(path), f"a mesh as {kind}", str(damage)[:200]) from damage
    triangles = np.asarray(getattr(mesh, "triangles", []), dtype=np.float64)
    return _float32(triangles.reshape(-1, 3, 3))


# What damaged meshes raise out of trimesh.
_TRIMESH_DAMAGE = (ValueError, KeyError, IndexError, TypeError, AttributeError, struct.error)


def _sampled(triangles: Array, subject: str) -> PointCloud:
    """Points of a mesh; the same ones each time."""
    corners = triangles.astype(np.float64)
    sides = corners[:, 1:] - corners[:, :1]
    with np.errstate(invalid="ignore"):  # corners that are not finite have no area
        has_area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) > 0.0
    has_area &= np.isfinite(corners).all(axis=(1, 2))
    if not has_area.any():
        raise CloudError(subject, "a mesh with at least one triangle", "none")
    mesh = TriangleMesh(triangles=triangles[has_area])
    return mesh.sampled(MESH_SAMPLE_COUNT, np.random.default_rng(0))


def _text_points(path: Path) -> Array:
    """(N, 3) first columns of numbers, separated by spaces, commas or semicolons; `#` comments."""
    with open_input(path) as file:
        data = file.read()
    first, _, rest = data.partition(b"\n")
    if re.match(rb"[\"\sA-Za-z_,;]+$", first):  # the names of the columns
        data = rest
    expected = "a cloud as PLY, PCD, LAS, LAZ, VTK, NPZ, mesh or text `x y z`"
    if not re.search(rb"\d", data):
        raise CloudError(str(path), expected, "no numbers")
    try:
        rows = np.loadtxt(io.BytesIO(data.translate(_SPACED)), ndmin=2)
    except ValueError as damage:
        raise CloudError(str(path), expected, str(damage)[:200]) from damage
    if rows.shape[1] < 3:
        raise CloudError(str(path), "at least the columns x y z", f"{rows.shape[1]} a line")
    return rows[:, :3]


_SPACED = bytes.maketrans(b",;", b"  ")


def read_points(path: Path, key: str, min_count: int = 1) -> PointCloud:
    """Read points, leaving out those that are not finite with one warning.

    Args:
        path: NPZ with `key` (N, 3), m, and optional `normals`; or PLY vertices.
        key: name of the array, `points` or `edges`.
        min_count: fewer finite points than this are unusable.

    Raises:
        InputError: no readable file.
        CloudError: neither format, or fewer than `min_count` finite points.
    """
    subject = str(path)
    normals: Array | None
    if _is_ply(path):
        ply = read_ply(path, CloudError)
        points, normals = _float32(ply.vertices), ply.normals
    else:
        points = _npz_array(path, key, (3,), CloudError)
        normals = read_npz(path, ("normals",), subject, CloudError).get("normals")
    if normals is not None and (normals.shape != points.shape or normals.dtype.kind not in "iuf"):
        raise CloudError(subject, f"normals of shape {points.shape}", f"{normals.shape}")
    return _cloud(points, normals, min_count, subject)


def _cloud(points: Array, normals: Array | None, min_count: int, subject: str) -> PointCloud:
    """The points that are finite, normals and all."""
    points = _float32(points)
    finite = np.isfinite(points).all(axis=1)
    if normals is not None:
        normals = _float32(normals)
        finite &= np.isfinite(normals).all(axis=1)
        normals = normals[finite]
    if not finite.all():
        _log.warning("%s: left out %d points that are not finite", subject, (~finite).sum())
    if finite.sum() < min_count:
        raise CloudError(subject, f"at least {min_count} finite points", f"{finite.sum()}")
    return PointCloud(points=points[finite], normals=normals)


def _is_ply(path: Path) -> bool:
    with open_input(path) as file:
        return file.read(3) == b"ply"


def _npz_array(path: Path, key: str, row: tuple[int, ...], error: type[InputError]) -> Array:
    """(N, *row) float32 array of an archive."""
    subject = str(path)
    arrays = read_npz(path, (key,), subject, error)
    if key not in arrays:
        raise error(subject, f"an array {key}", "none")
    array = arrays[key]
    if array.shape[1:] != row or array.ndim == 0 or array.dtype.kind not in "iuf":
        shape = ", ".join(["N", *(str(size) for size in row)])
        raise error(subject, f"{key} of shape ({shape})", f"{array.shape} of {array.dtype}")
    return _float32(array)


def _float32(values: Array) -> Array:
    """As float32; what it cannot hold becomes infinite and is refused or left out later."""
    with np.errstate(over="ignore"):
        return values.astype(np.float32)
